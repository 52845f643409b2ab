"""Response of a model per unit of what force cells of the exciters measure."""

import numpy as np

from balance_cli.model.exciter_loads import true_load_matrices
from balance_cli.model.system_response import response


def exciter_response(system, solution):
    """T (f, c, 6) per unit of the loads that the exciters' force cells measure, all of them attached."""
    lines = np.arange(len(solution.frequency))
    attached = np.ones((len(lines), 6), bool)
    return np.asarray(response(system, solution) @ true_load_matrices(system, solution, lines, attached))
