"""Local models of a record are fitted once for all tests of a file: they follow from the spectrum alone."""

import hashlib
from dataclasses import replace

import pytest

from balance_cli.signals.local import models, nonperiodic_spectrum, response


def contents(spectrum):
    """All that local models depend on."""
    run = spectrum.run
    arrays = (spectrum.frequency, spectrum.channels, spectrum.loads, spectrum.excited)
    scales = (spectrum.channel_scale, spectrum.load_scale)
    digest = hashlib.sha256(b"".join(part.tobytes() for part in (*arrays, *scales)))
    return digest.hexdigest(), spectrum.channels.shape, spectrum.components, run.rotor_speed, run.excitation


@pytest.fixture(scope="module", autouse=True)
def fitted_once(request):
    """`fit_local_models` of equal spectra gives the models that it gave before."""
    fit, kept = models.fit_local_models, {}

    def fit_or_take(spectrum, estimator="lrm"):
        if spectrum.window_noise is not None:
            return fit(spectrum, estimator)
        key = contents(spectrum), estimator
        if key not in kept:
            kept[key] = fit(spectrum, estimator)
        return replace(kept[key], spectrum=replace(kept[key].spectrum, run=spectrum.run))

    with pytest.MonkeyPatch.context() as patch:
        for module in (models, nonperiodic_spectrum, response, request.module):
            patch.setattr(module, "fit_local_models", fit_or_take, raising=False)
        yield
