"""A model that misses its data names the run and the channel that it misses most."""

from dataclasses import replace

import numpy as np
import pytest

from balance_cli.cli.identify import model_summary, model_text
from balance_cli.estimation.fit_quality import fit_quality
from balance_cli.estimation.identified_model import FitQuality, RunFit
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from tests.support.model_lines import model_lines
from tests.support.report_content import model
from tests.support.rigs import two_degrees_of_freedom


@pytest.mark.parametrize("channel", [0, 1])
def test_the_channel_that_was_changed_in_one_run_is_the_worst_of_that_run(channel):
    physical = balance_model(two_degrees_of_freedom())
    rng, frequency = np.random.default_rng(3), np.linspace(2.0, 80.0, 80)
    runs = [model_lines(physical, name, i, frequency, 1e-4, rng) for name, i in (("Fz", 2), ("My", 4))]
    volts = runs[1].channels.copy()
    volts[:, channel] *= 1.01
    names = physical.geometry.channel_names
    batches = stack_runs([runs[0], replace(runs[1], channels=volts)], (), names)
    quality = fit_quality(batches, physical.system(physical.parameters.value), 0.0, (0.0, 100.0))
    assert quality.worst_run == "sweep-My"
    assert quality.runs["sweep-My"].worst_channel == names[channel]


def test_text_and_json_of_a_misfit_name_run_and_channel_and_those_of_a_good_fit_say_nothing():
    runs = {
        "sweep-Fx": RunFit(600.0, 500.0, 0.07, 0.001, "x.piezo"),
        "sweep-My": RunFit(9e3, 500.0, 0.07, 0.001, "y1.strain"),
    }
    misfit = model(quality=FitQuality(9600.0, 1000.0, 0.07, runs))
    text = "\n".join(model_text(misfit))
    assert "It misses sweep-My most (chi2/dof 18), there channel y1.strain" in text
    assert model_summary(misfit)["runs"]["sweep-My"]["worst_channel"] == "y1.strain"
    assert "It misses" not in "\n".join(model_text(model()))
    unknown = model(chi2_per_dof=9.0)
    assert "It misses sweep-Fx most (chi2/dof 9)\n" in "\n".join(model_text(unknown))
