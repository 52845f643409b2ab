"""Arguments of the public interface that are of another type, unknown or out of range."""

import math

import numpy as np
import pytest

import balance_cli as bal
from balance_cli.api.arguments import check_arguments

RIG, RUN = "configs/rts-6.yaml", "sample_data/wind-1.h5"


@pytest.fixture(scope="module")
def response():
    return bal.identify([], RIG, method="computed")


@pytest.mark.parametrize("path", ["model.h5", "configs/rts-6.yaml", ""])
def test_a_path_is_no_response(path):
    """It had been taken for the static matrix, with loads to match."""
    with pytest.raises(TypeError, match=r"`response` must be .* not str\. Read a file of results by `load_artefact`"):
        bal.reduce(RUN, None, path)


def test_a_path_is_no_calibration_and_no_model(response):
    with pytest.raises(TypeError, match=r"`calibration` must be Calibration or None, not str\. Read a file"):
        bal.reduce(RUN, "calibration.h5", response)
    with pytest.raises(TypeError, match="`model` must be IdentifiedModel, not str"):
        bal.diagnose("model.h5", RUN)


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"method": "filter"}, "method: `filter` is not one of harmonic, kalman, smoother"),
        ({"load_model": "all"}, "load_model: `all` is not one of"),
        ({"interpolation": "cubic"}, "interpolation: `cubic` is not one of"),
        ({"mean_loads": "direct"}, "mean_loads: `direct` is not one of"),
        ({"harmonics": 0}, "harmonics: must be from 1 to 64, not 0"),
        ({"harmonics": -1}, "harmonics: must be from 1 to 64"),
        ({"rotor": 0}, "rotor: must be 1 or more"),
        ({"method": "kalman", "lag": -0.1}, "lag: must be 0 or more, and finite, not -0.1"),
        ({"method": "kalman", "lag": math.inf}, "lag: must be 0 or more, and finite, not inf"),
    ],
)
def test_words_and_numbers_that_are_not_offered(response, arguments, words):
    with pytest.raises(bal.UserError) as raised:
        bal.reduce(RUN, None, response, **arguments)
    assert words in str(raised.value)


@pytest.mark.parametrize(
    "arguments",
    [{"harmonics": 2.0}, {"harmonics": "8"}, {"harmonics": True}, {"lag": "x"}, {"lag": math.nan}, {"zero": 3}],
)
def test_other_types(response, arguments):
    (name,) = arguments
    with pytest.raises(TypeError, match=f"`{name}` must be"):
        bal.reduce(RUN, None, response, **arguments)


def test_the_other_functions(response):
    with pytest.raises(bal.UserError, match="method: `lsq` is not one of ls, ml"):
        bal.identify([], RIG, method="lsq")
    with pytest.raises(TypeError, match="`effects` must be a list, not str"):
        bal.identify([], RIG, effects="gyroscopic-coupling")
    with pytest.raises(TypeError, match="`geometry` must be Geometry or text or PathLike, not IdentifiedModel"):
        bal.calibrate("sample_data/static-bare.h5", response)
    with pytest.raises(bal.UserError, match="significance: must be between 0 and 1"):
        bal.calibrate("sample_data/static-bare.h5", RIG, significance=1.0)
    with pytest.raises(bal.UserError, match="estimator: `h3` is not one of"):
        bal.frequency_response("sample_data/sweep-Fz-low.h5", RIG, estimator="h3")
    for band in ((100, 5), (math.inf, math.inf)):
        with pytest.raises(bal.UserError, match="band: no line lies between"):
            bal.frequency_response("sample_data/sweep-Fz-low.h5", RIG, band=band)
    with pytest.raises(TypeError, match="`band` must be 2 numbers, not str"):
        bal.frequency_response("sample_data/sweep-Fz-low.h5", RIG, band="ab")
    with pytest.raises(bal.UserError, match="seed: must be 0 or more"):
        bal.simulate(RIG, seed=-1)
    with pytest.raises(bal.UserError, match="noise: must be from 0 to"):
        bal.simulate(RIG, noise=-1.0)


@check_arguments
def accept(band: tuple[float, float] | None = None, count: int = 1) -> object:
    return band


def test_numbers_of_numpy_are_numbers():
    assert accept(np.array([1.0, 2.0])).tolist() == [1.0, 2.0]
    assert accept([1, np.float32(2.0)]) == [1, 2.0]
    assert accept((1, 2), np.int64(3)) == (1, 2)
    with pytest.raises(TypeError, match="`band` must be 2 numbers or None, not tuple"):
        accept((1, 2, 3))
