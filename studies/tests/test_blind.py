"""The blind study: its simulator against direct integration, and a small campaign through the package."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import balance_cli as bal
from studies.blind import campaign
from studies.blind.hidden import (
    channel_gain,
    cubic_stiffness,
    dry_friction,
    gyroscopic_coupling,
    nothing,
    support_flexibility,
)
from studies.blind.judge import BLIND_KINDS, blind_table, causes_of, load_errors
from studies.blind.physics import equilibria, linear_forces, nonlinear_forces, static_forces
from studies.blind.records import true_rig
from studies.blind.rigs import draw_declared, draw_true
from studies.blind.unknown import UNKNOWN

SEED = 12


def drawn(cause=None):
    truth = true_rig(draw_true(draw_declared(np.random.default_rng([SEED, 1])), np.random.default_rng([SEED, 2])))
    return truth if cause is None else cause(truth, np.random.default_rng(SEED)).truth


def pulse(time, size):
    """A smooth load (n, 6) in all components, zero at the end of the record."""
    return np.multiply.outer(np.exp(-(((time - 0.1) / 0.02) ** 2)), size)


@pytest.mark.parametrize("cause", [None, support_flexibility, gyroscopic_coupling], ids=["plain", "support", "spin"])
def test_convolution_is_the_integral_of_the_equations_of_motion(cause):
    mechanics, spin, rate = drawn(cause).mechanics, 60.0, 4000.0
    count = int(np.ceil(20 / mechanics.slowest_decay * rate))
    time, size = np.arange(count) / rate, np.array([30.0, -20.0, 50.0, 4.0, 6.0, -5.0])
    forces = linear_forces(mechanics, pulse(time, size), rate, spin, rate / 2)
    n = mechanics.size
    inverse = np.linalg.inv(mechanics.M)

    def slope(t, x):
        push = mechanics.B @ pulse(np.array([t]), size)[0] - (mechanics.D + spin * mechanics.G) @ x[n:]
        elastic = mechanics.K @ x[:n] + mechanics.E.T @ (mechanics.stiffness * (mechanics.E @ x[:n]))
        return np.concatenate([x[n:], inverse @ (push - elastic)])

    at = np.arange(0, int(0.3 * rate), 40)
    solution = solve_ivp(slope, (0, 0.3), np.zeros(2 * n), t_eval=time[at], rtol=1e-9, atol=1e-13, max_step=2e-3)
    integrated = solution.y[:n].T @ mechanics.E.T * mechanics.stiffness
    assert forces[at] == pytest.approx(integrated, abs=2e-6 * np.abs(integrated).max())


def test_runge_kutta_steps_are_the_convolution_where_the_law_is_zero_and_hold_a_static_load():
    truth = drawn(cubic_stiffness)
    mechanics, rate = truth.mechanics, 8000.0
    (law,) = mechanics.laws
    linear = replace(mechanics, laws=(replace(law, force=lambda d, state: 0.0 * d),))
    time, size = np.arange(8000) / (2 * rate), np.array([30.0, -20.0, 50.0, 4.0, 6.0, -5.0])
    stepped = nonlinear_forces(linear, pulse(time, size)[:, None], rate, np.zeros((1, mechanics.size)))[:, 0]
    padded = np.arange(int(np.ceil(20 / mechanics.slowest_decay * rate))) / rate
    exact = linear_forces(mechanics, pulse(padded, size), rate, 0.0, rate / 2)[: len(stepped)]
    assert stepped == pytest.approx(exact, abs=1e-5 * np.abs(exact).max())
    load = 20 * size
    forces = static_forces(mechanics, load[None])[0]
    d = forces[law.cell] / mechanics.stiffness[law.cell]
    # The cells and the spring beside one of them carry the plate's load together.
    whole = mechanics.E.T @ forces + mechanics.E[law.cell] * law.force(np.array([d]), np.zeros(1))
    assert whole == pytest.approx(mechanics.B @ load, abs=1e-8 * np.abs(load).max())


def test_a_rig_with_a_dry_contact_is_in_balance_at_every_static_load():
    declared = draw_declared(np.random.default_rng([49, 1]))
    truth = true_rig(draw_true(declared, np.random.default_rng([49, 2])))
    mechanics = dry_friction(truth, np.random.default_rng([49, 5])).truth.mechanics
    (law,) = mechanics.laws
    loads = campaign.static_loads(declared, campaign.draw_size(declared, np.random.default_rng([49, 77])), 0.0)
    elastic = mechanics.K + (mechanics.E.T * mechanics.stiffness) @ mechanics.E
    rest, slider = equilibria(mechanics, loads), np.zeros(1)
    for q, load in zip(rest, loads, strict=True):
        d = mechanics.E[law.cell : law.cell + 1] @ q
        force = law.force(d, slider)
        assert elastic @ q + mechanics.E[law.cell] * force == pytest.approx(
            mechanics.B @ load, abs=1e-9 * abs(loads).max()
        )
        slider = law.advance(d, slider)


def test_a_small_campaign_is_identified_diagnosed_by_gain_and_reduced_within_its_intervals(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "CYCLES_PER_PERIOD", 20.0)
    monkeypatch.setattr(campaign, "REVOLUTIONS", 50)
    truth = drawn(channel_gain)
    true = campaign.write_campaign(truth, draw_declared(np.random.default_rng([SEED, 1])), "multisine", SEED, tmp_path)
    fitted = [str(path) for pattern in ("static-*.h5", "sweep-*-1.h5") for path in sorted(tmp_path.glob(pattern))]
    (label,) = [f"channel-gain@{truth.rig.channels[i].name}" for i in truth.dynamics]
    (gain,) = [function(np.zeros(1))[0].real for function in truth.dynamics.values()]
    plain = bal.identify(fitted, str(tmp_path / "geometry.yaml"))
    model = bal.identify(fitted, str(tmp_path / "geometry.yaml"), effects=[label])
    assert plain.quality.chi2_per_dof > 3.0
    assert model.quality.chi2_per_dof == pytest.approx(1.0, abs=0.06)
    value = dict(zip(model.parameters.names, model.parameters.value, strict=True))[f"{label}.gain"]
    assert value == pytest.approx(gain, abs=1e-3)
    bal.reduce(sorted(map(str, tmp_path.glob("wind-*.h5"))), None, model).to_frame().to_csv(tmp_path / "loads.csv")
    rows = load_errors(tmp_path / "loads.csv", true)
    tested = rows[rows["z"].notna() & (rows["harmonic"] > 0)]
    assert len(tested) == 2 * 6 * 8 * 2
    assert tested["z"].abs().lt(2).mean() > 0.9
    assert tested["z"].abs().max() < 5


def test_seeds_hide_nothing_one_effect_several_or_an_unknown_cause():
    counts = [len(causes_of(seed)) for seed in range(30)]
    assert counts[:20] == [1] * 20 and counts[20:24] == [2, 3, 2, 3] and counts[24:] == [1] * 6
    assert len({causes_of(seed)[0] for seed in range(4, 20)}) == 16
    row = {"failed": "", "right": 1, "of": 1, "verdict": "explained", "rows": 10, "worst_z": 2.0, "cpu": 9, "memory": 5}
    rows = pd.DataFrame(
        [
            {**row, "causes": name, "unflagged": u, "coverage": c}
            for name, u, c in (("channel_gain", 10, 1.0), ("time_delay", 5, 0.4))
        ]
    )
    (table,) = blind_table(rows).to_dict("records")
    assert table["kind"] == "one effect" and table["labels_right"] == "2 of 2"
    assert table["unflagged"] == pytest.approx(0.75) and table["coverage"] == pytest.approx(0.8)
    names = ["nothing", "time_delay", "time_delay + low_pass", "bilinear_cell", "saturation"]
    kinds = blind_table(pd.concat([rows[:1].assign(causes=name) for name in names]))
    assert list(kinds["kind"]) == ["nothing", "one effect", "several", "other cause"]
    assert list(kinds["campaigns"]) == [1, 1, 1, 2]


def test_studies_of_sound_rigs_and_of_unknown_causes_hide_nothing_else():
    assert {BLIND_KINDS["nothing"](seed) for seed in range(9)} == {(nothing,)}
    assert {BLIND_KINDS["unknown"](seed)[0] for seed in range(len(UNKNOWN))} == set(UNKNOWN)
