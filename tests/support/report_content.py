"""Small artefacts with known content, from which the report's tests make pages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from balance_cli.calibration.result import Calibration
from balance_cli.campaign.recording.run import MemorySource, Run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.campaign.rig.geometry import Geometry
from balance_cli.estimation.identified_model import FitQuality, IdentifiedModel, ModeTable, ParameterTable, RunFit
from balance_cli.io.artefacts import Artefact, Input, Provenance
from balance_cli.model.balance import balance_model
from balance_cli.model.modes import modes
from balance_cli.model.system_response import response, solve
from balance_cli.reduction.result import CheckErrors, HubLoads, RunLoads
from balance_cli.signals.response.transfer import Transfer
from balance_cli.signals.run_spectrum import FrequencyResponse
from balance_cli.steps.calibrate import calibrate
from tests.support.rigs import rotor_balance

FREQUENCY = np.linspace(2.0, 150.0, 45)
NOISE = 1e-4
"""Standard deviation of the measured responses, as a fraction of a newton (or newton metre) at the cell."""


def truth(scale: float = 0.0) -> np.ndarray:
    """Parameters with every stiffness and mass off by `scale` of its tolerance, in alternating directions."""
    parameters = balance_model(rotor_balance()).parameters
    signs = np.where(np.arange(len(parameters)) % 2, 1.0, -1.0)
    return parameters.value + scale * signs * parameters.sigma


def model(method: str = "ls+ml", scale: float = 0.0, chi2_per_dof: float = 1.0, **changes: object) -> IdentifiedModel:
    geometry = rotor_balance()
    physical = balance_model(geometry)
    parameters, theta = physical.parameters, truth(scale)
    found = modes(physical.system(theta))
    sigma = parameters.sigma * (1.0 if method == "computed" else 0.01)
    table = ParameterTable(
        names=parameters.names,
        units=parameters.units,
        value=theta,
        sigma=sigma,
        declared=parameters.value,
        declared_sigma=parameters.sigma,
        informed_by=tuple("data" if free else "exact" for free in parameters.free),
    )
    shapes = ModeTable(
        coordinates=found.coordinates,
        frequency=found.frequency,
        damping_ratio=found.damping_ratio,
        sigma_frequency=np.full(len(found.frequency), 0.01),
        sigma_damping_ratio=np.full(len(found.frequency), 1e-4),
        shape=found.shape,
    )
    runs = {"sweep-Fx": RunFit(500.0 * chi2_per_dof, 500.0, 0.07, 0.001)}
    made = IdentifiedModel(
        form="physical",
        method=method,
        start="geometry",
        geometry=geometry,
        parameters=table,
        covariance=np.diag(sigma**2),
        modes=shapes,
        quality=FitQuality(500.0 * chi2_per_dof, 500.0, 0.07, runs),
        unidentifiable=("all masses and stiffnesses together",),
        channels_left_out={},
        iterations=0 if method == "computed" else 5,
        converged=True,
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def measured(component: str, level: float, geometry: Geometry | None = None) -> FrequencyResponse:
    """The exact response of the declared rig, said to have noise of NOISE on every channel, as a force."""
    geometry = geometry or rotor_balance()
    system = balance_model(geometry).system()
    T = response(system, solve(system, FREQUENCY))[:, :, [COMPONENTS.index(component)]]
    sensitivity = np.array([channel.sensitivity for channel in geometry.channels])
    k, c, _ = T.shape
    covariance = np.broadcast_to(np.diag((NOISE * sensitivity) ** 2), (k, c, c)).astype(complex)
    coherence = np.full((k, c, 1), 0.9999)
    return FrequencyResponse(
        run=f"sweep-{component}-{level:g}",
        channel_names=geometry.channel_names,
        components=(component,),
        estimator="periodic",
        frequency=FREQUENCY,
        response=T,
        channel_covariance=covariance,
        load_covariance=np.ones((k, 1, 1), complex),
        coherence=coherence,
        multiple_coherence=coherence[:, :, 0],
        level=(level,),
    )


def transfer(components: tuple[str, ...] = ("Fx", "Mz")) -> Transfer:
    responses = tuple(measured(name, level) for name in components for level in (5.0, 20.0))
    return Transfer(geometry=rotor_balance(), responses=responses)


def loads(
    response_words: str = "static matrix", error: float = 0.5, redundancy: float = 1.0, **changes: object
) -> HubLoads:
    """Two check runs (Fx and Fz, then Fz applied) and one wind run."""
    runs = {
        "check-1": _run(
            "check-1",
            response_words,
            1.0,
            CheckErrors(
                {"Fx": error, "Fz": 2 * error},
                {"My": 0.3 * error},
                {"Fx": 0.01, "Fz": 0.02},
                {"My": 0.004},
                np.zeros((4, 6), complex),
            ),
        ),
        "check-2": _run(
            "check-2",
            response_words,
            1.0,
            CheckErrors({"Fz": error}, {"Fx": 0.1 * error}, {"Fz": 0.02}, {"Fx": 0.005}, np.zeros((4, 6), complex)),
        ),
        "wind-1": _run("wind-1", response_words, redundancy, None),
    }
    return replace(HubLoads("harmonic", response_words, rotor_balance(), runs), **changes)  # type: ignore[arg-type]


def _run(name: str, words: str, redundancy: float, check: CheckErrors | None) -> RunLoads:
    harmonics = np.arange(4)
    amplitude = (10.0 + np.arange(6)) / (1.0 + harmonics[:, None]) * np.exp(0.5j * harmonics[:, None])
    chi2 = np.array([np.nan, 1.0, 1.0, redundancy])
    flags = tuple((("redundancy" if value > 2.0 else "") if n else "no zero",) * 6 for n, value in enumerate(chi2))
    return RunLoads(
        run=name,
        kind="check" if check else "wind",
        response=words,
        trim="bare",
        components=COMPONENTS,
        frequency_hz=17.5 * harmonics,
        amplitude=amplitude,
        sigma_cosine=np.full((4, 6), 0.02),
        sigma_sine=np.full((4, 6), 0.02),
        flags=flags,
        redundancy=chi2,
        redundancy_limit=np.array([np.nan, 2.0, 2.0, 2.0]),
        condition=np.array([3.0, 10.0, 20.0, 480.0]),
        left_out={"z2.piezo": "clipped"} if name == "wind-1" else {},
        interval=(1.5, 19.5),
        check=check,
    )


def calibration() -> Calibration:
    """Straight lines with a little noise, each component up and down in steps."""
    geometry = rotor_balance()
    system = balance_model(geometry).system()
    names = [channel.name for channel in geometry.channels if channel.measures_dc]
    rows = [geometry.channel_names.index(name) for name in names]
    C0 = np.real(response(system, solve(system, np.zeros(1)))[0][rows])
    steps = np.array([0.0, 50.0, 100.0, 50.0, 0.0, -50.0, -100.0, -50.0])
    loads = np.vstack([np.outer(steps, unit) for unit in np.eye(6)])
    noise = 1e-4 * np.random.default_rng(3).normal(size=(len(loads), len(names)))
    source = MemorySource(loads @ C0.T + noise, loads)
    run = Run("static-1", geometry.rig, "static", tuple(names), len(loads), source, trim="bare")
    return calibrate([run], geometry)


def artefact(format: str, content: object, digest: str, inputs: tuple[Input, ...] = ()) -> Artefact:
    provenance = Provenance("some-command", {"harmonics": 3}, inputs, {"numpy": "2.0"}, "2026-01-02T03:04:05+00:00")
    return Artefact(format, content, provenance, digest)


def campaign() -> list[tuple[Path, Artefact]]:
    """One artefact of each kind, two models, and loads by three responses."""
    computed = artefact("balance-model/1", model("computed", scale=2.0, chi2_per_dof=900.0), "c" * 64)
    identified = artefact("balance-model/1", model(), "d" * 64)
    by_model = (Input("model.h5", "model", "d" * 64),)
    return [
        (Path("somewhere/cal.h5"), artefact("balance-calibration/1", calibration(), "a" * 64)),
        (Path("tf.h5"), artefact("balance-transfer/1", transfer(), "b" * 64)),
        (Path("computed.h5"), computed),
        (Path("model.h5"), identified),
        (Path("loads-static.h5"), artefact("balance-loads/1", loads(), "e" * 64)),
        (Path("loads-tf.h5"), artefact("balance-loads/1", loads("measured response (local)", 0.05, 9.0), "f" * 64)),
        (
            Path("loads-model.h5"),
            artefact("balance-loads/1", loads("physical model (ls+ml)", 0.01), "0" * 64, by_model),
        ),
    ]
