"""Degrees of freedom of the noise behind a score: closed forms for one part, for several, and for runs together."""

import numpy as np
import pytest

from balance_cli.diagnosis.search.noise_dof import RunInformation, noise_dof
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.diagnosis.significance import gain_p_value
from balance_cli.estimation.measurements import stack_runs
from balance_cli.signals.run_spectrum import NoisePart, RunSpectrum

CHANNELS = ("a", "b", "c")
MIN_DOF = SETTINGS.score.min_noise_dof
FITTED, NONE = np.array([0], np.intp), np.zeros((1, 1))


def run_information(slopes: np.ndarray, parts: tuple[NoisePart, ...] = (), dof: float = 30.0) -> RunInformation:
    """Of a run of k lines with slopes (k, 3, p) and unit weights; the first parameter is fitted."""
    k = len(slopes)
    lines = RunSpectrum(
        run="run",
        channel_names=CHANNELS,
        components=("Fx",),
        frequency=np.arange(1.0, k + 1.0),
        channels=np.zeros((k, 3), complex),
        loads=np.ones((k, 1), complex),
        covariance=np.broadcast_to(np.diag([1.0, 1.0, 1.0, 0.0]).astype(complex), (k, 4, 4)),
        dof=dof,
        noise_parts=parts,
    )
    (batch,) = stack_runs([lines], [], CHANNELS)
    flat = slopes.reshape(-1, slopes.shape[2])
    information = flat.T @ flat
    diagonal = np.diag(information)[1:]
    weighted = slopes.astype(complex) if parts else None
    return RunInformation(batch, np.zeros(len(information)), information[:1], diagonal, diagonal, weighted)


INVERSE = 1.0 - 3.0 / 30.0
"""Share of the dof that is left where 3 channels are weighted by the inverse of a covariance of 30."""


def part(shape: np.ndarray, share: np.ndarray, size: float = 1.0, error: float = 0.5) -> NoisePart:
    return NoisePart(np.asarray(shape, float), np.asarray(share, float), size, error)


def slopes_along(*channels: int, lines: int = 4) -> np.ndarray:
    """Slopes (k, 3, 1 + n): nothing in the fitted parameter, one channel in each of the others."""
    slopes = np.zeros((lines, 3, 1 + len(channels)))
    for i, channel in enumerate(channels):
        slopes[:, channel, 1 + i] = 1.0
    return slopes


def test_a_run_alone_has_the_dof_of_its_noise():
    run = run_information(slopes_along(0), dof=40.0)
    (found,) = noise_dof([run], FITTED, [np.array([1])], [NONE], MIN_DOF)
    assert found == pytest.approx(run.batch.runs[0].noise_dof)
    assert run.batch.runs[0].noise_dof == 80.0


def test_runs_that_tell_alike_add_up():
    run = run_information(slopes_along(0), dof=40.0)
    assert noise_dof([run, run, run], FITTED, [np.array([1])], [NONE], MIN_DOF)[0] == pytest.approx(240.0)


def test_each_direction_has_the_dof_of_the_part_that_it_feels():
    """A part with size s and standard error e is known as an estimate with 2 s^2 / e^2 degrees of freedom."""
    parts = (
        part(np.diag([1.0, 1.0, 0.0]), np.ones(4), 1.0, np.sqrt(2.0 / 50.0)),
        part(np.diag([0.0, 0.0, 1.0]), np.ones(4), 3.0, 1.5),
    )
    run = run_information(slopes_along(0, 2), parts)
    found = noise_dof([run], FITTED, [np.array([1]), np.array([2])], [NONE, NONE], MIN_DOF)
    assert found == pytest.approx([50.0 * INVERSE, 8.0 * INVERSE])


def test_two_parts_combine_by_satterthwaite():
    """Sizes 1 and 3 with 50 and 8: 4^2 / (1 / 50 + 9 / 8)."""
    shape = np.diag([1.0, 0.0, 0.0])
    parts = (part(shape, np.ones(4), 1.0, np.sqrt(2.0 / 50.0)), part(shape, np.ones(4), 3.0, 1.5))
    run = run_information(slopes_along(0), parts)
    assert noise_dof([run], FITTED, [np.array([1])], [NONE], MIN_DOF)[0] == pytest.approx(
        INVERSE * 16.0 / (1 / 50 + 9 / 8)
    )


def test_a_part_that_was_found_to_be_nothing_is_doubtful_all_the_same():
    shape = np.diag([1.0, 0.0, 0.0])
    parts = (part(shape, np.ones(4), 1.0, 0.0), part(shape, np.ones(4), 0.0, 0.5))
    run = run_information(slopes_along(0), parts)
    assert noise_dof([run], FITTED, [np.array([1])], [NONE], MIN_DOF)[0] == pytest.approx(INVERSE * 2.0 / 0.25)


def test_a_part_counts_in_its_own_lines_only():
    shape, later = np.diag([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])
    parts = (part(shape, np.ones(4), 1.0, 0.1), part(shape, later, 1.0, 0.5))
    slopes = slopes_along(0)
    slopes[2:] = 0.0
    run = run_information(slopes, parts)
    shown = 4.0 * (1.0 + 1.0 + 0.25**2 + 0.25**2) / 2.5**2
    (found,) = noise_dof([run], FITTED, [np.array([1])], [NONE], MIN_DOF)
    assert found == pytest.approx(INVERSE * 2.0 / (0.01 * shown)), "the later lines tell a quarter as much of it"


def test_a_noise_that_another_hides_in_most_lines_has_the_dof_of_the_others():
    """The noise of a load in three of four lines, 1000 times that of the channel: one line tells the latter."""
    shape, loaded = np.diag([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 1.0, 1.0])
    parts = (part(np.eye(3), np.ones(4), 1.0, 0.25), part(shape, loaded, 1e6, 0.0))
    slopes = slopes_along(0, 1)
    slopes[1:, 0] = 0.0
    found = noise_dof([run_information(slopes, parts)], FITTED, [np.array([1]), np.array([2])], [NONE, NONE], MIN_DOF)
    assert found == pytest.approx([INVERSE * 32.0 / 4.0, INVERSE * 32.0])


def test_what_the_fitted_parameters_take_along_is_left_out():
    """A candidate that shows in channels 0 and 2, and whose share in 2 a fitted parameter takes, feels channel 0."""
    parts = (part(np.diag([1.0, 0.0, 0.0]), np.ones(4), 1.0, 0.1), part(np.diag([0.0, 0.0, 1.0]), np.ones(4), 1.0, 0.5))
    slopes = np.zeros((4, 3, 2))
    slopes[:, 2, 0] = 1.0
    slopes[:, 0, 1] = slopes[:, 2, 1] = 1.0
    run = run_information(slopes, parts)
    assert run.variance(FITTED, np.array([1]), np.ones((1, 1))) == pytest.approx([4.0])
    assert noise_dof([run], FITTED, [np.array([1])], [np.ones((1, 1))], MIN_DOF)[0] == pytest.approx(
        INVERSE * 2.0 / 0.01
    )


def test_a_noise_of_which_nothing_is_known_makes_no_gain_significant():
    shape = np.diag([1.0, 0.0, 0.0])
    run = run_information(slopes_along(0), (part(shape, np.ones(4), 1.0, 0.1), part(shape, np.ones(4), 0.0, 1e12)))
    (found,) = noise_dof([run], FITTED, [np.array([1])], [NONE], MIN_DOF)
    assert found == 1.0
    assert gain_p_value(1e3, 1, float(found)) > 0.01


def test_without_information_the_noise_is_no_limit():
    run = run_information(np.zeros((4, 3, 2)))
    assert noise_dof([run], FITTED, [np.array([1])], [NONE], MIN_DOF)[0] == np.inf
