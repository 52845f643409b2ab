"""The study of static calibration: what it loads, what it hides, and how it counts."""

import numpy as np
import pandas as pd

from balance_cli.calibration.load_series import find_load_series
from balance_cli.calibration.term_support import find_supported_terms
from balance_cli.campaign.rig.components import COMPONENTS
from studies.calibration import (
    CHANNELS,
    CHECKS,
    FULL_RANGE,
    MAX_NONLINEAR_TERMS,
    NOISE,
    SIZE,
    TERMS,
    calibration_chunk,
    calibration_table,
    draw_balance,
    simulate_calibration,
    stand_schedule,
)


def test_the_schedule_is_one_of_a_calibration_stand():
    x, sequence = stand_schedule()
    assert 750 <= len(x) <= 850 and 60 <= sequence[-1] + 1 <= 80
    np.testing.assert_array_equal(find_load_series(x, np.zeros(len(x), int)), sequence)
    assert np.all(x.max(axis=0) == 1.0) and np.all(x.min(axis=0) == -1.0)
    signs = {
        (i, j, np.sign(row[i]), np.sign(row[j])) for row in x for i in range(6) for j in range(i) if row[i] * row[j]
    }
    assert len(signs) == 15 * 4
    assert np.all((x != 0).sum(axis=1) <= 2)
    assert find_supported_terms(TERMS, x, sequence, COMPONENTS).unsupported == {}


def test_balances_are_drawn_as_stated():
    drawn = [draw_balance(np.random.default_rng(seed)) for seed in range(200)]
    numbers = np.array([[len(one.curved(c)) for c in range(len(CHANNELS))] for one in drawn])
    assert set(numbers.ravel()) == set(range(MAX_NONLINEAR_TERMS + 1))
    hidden = set().union(*(one.curved(c) for one in drawn for c in range(len(CHANNELS))))
    assert hidden == {term for term in TERMS if not term.linear}
    sizes = np.concatenate([np.abs(one.coefficients[6:] / one.range).ravel() for one in drawn])
    sizes = sizes[sizes > 0]
    assert SIZE[0] <= sizes.min() < 1.05 * SIZE[0] and 0.95 * SIZE[1] < sizes.max() <= SIZE[1]
    noise = np.concatenate([one.noise / one.range for one in drawn])
    assert NOISE[0] <= noise.min() and noise.max() <= NOISE[1]


def test_check_loads_are_all_six_at_once_after_a_row_without():
    rng = np.random.default_rng(0)
    points, (_, channels, loads) = simulate_calibration(draw_balance(rng), rng)
    assert len(channels) == len(loads) == CHECKS + 1 and not loads[0].any() and np.all(loads[1:] != 0)
    assert np.all(np.abs(loads) <= FULL_RANGE) and points.channels.shape == (len(points.loads), len(CHANNELS))


def test_one_balance_is_counted():
    rows = calibration_chunk(0)
    assert list(rows["component"]) == list(COMPONENTS)
    assert (rows["missed"] == "-").all() and (rows["spurious"] == "-").all() and (rows["solved"] == 1.0).all()
    assert rows["hits"].between(0.5, 1.0).all() and (rows["rms"] / rows["floor"]).between(0.8, 1.6).all()


def test_the_table_counts_balances_and_terms():
    base = {"curved": 10, "undecidable": 0, "wrong_channels": 0, "refused": 0, "set_aside": 0, "solved": 1.0}
    base |= {"hits": 0.95, "rms": 2.0, "floor": 1.0}
    rows = pd.DataFrame(
        [base | {"seed": 0, "component": name, "missed": "-", "spurious": "-"} for name in ("Fx", "Fy")]
        + [
            base | {"seed": 1, "component": name, "missed": "g1: Fx^2; g2: Fy^2", "spurious": "g1: |Fx|"}
            for name in ("Fx", "Fy")
        ]
    )
    table = calibration_table(rows).set_index(["quantity", "component"])["value"]
    assert table["balances", "all"] == 2 and table["curved terms", "all"] == 20
    assert table["share with all true terms", "all"] == 0.5 and table["terms missed", "all"] == 2
    assert table["terms spurious", "all"] == 1
    assert table["coverage of 95 % intervals", "Fy"] == 0.95 and table["rms error over noise floor", "all"] == 2.0
