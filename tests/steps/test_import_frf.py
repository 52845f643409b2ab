"""Frequency responses of other programs: the true ones of a rig, written as laboratories do, give its true loads."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import savemat

from balance_cli.api import reduction
from balance_cli.campaign.recording.frf_map import read_frf_map
from balance_cli.campaign.recording.run_file import write_run
from balance_cli.campaign.rig.components import COMPONENTS
from balance_cli.cli import balance
from balance_cli.importers.frf import open_frf
from balance_cli.io.artefacts import Provenance, load_artefact, save_artefact
from balance_cli.io.errors import UserError
from balance_cli.signals.response.line_scatter import WINDOW_TERMS, independent_share, scatter_variance
from balance_cli.signals.response.transfer import Transfer, sigma_notes
from balance_cli.steps.frf_checks import geometry_findings, static_findings
from balance_cli.steps.import_frf import import_responses
from balance_cli.steps.sweep_tf import estimate_responses
from tests.support.frf_files import AVERAGES, noisy_responses, uff_map, write_binary_uff, write_map, write_uff
from tests.support.truth import true_response

FREQUENCY = np.arange(0.0, 150.01, 0.25)
PLATE = 14
"""Channels of the cells; the last one, of the shaft, reads exactly nothing of forces, which counts as not measured."""


@pytest.fixture(scope="module")
def truth(campaign):
    """The true responses (k, c, 6) of the rig of the campaign at FREQUENCY, with noise, and their coherence."""
    exact = true_response(campaign.rig, np.maximum(FREQUENCY, 1e-3))
    return exact, *noisy_responses(exact)


def imported(map_path, *files, geometry):
    mapping = read_frf_map(map_path)
    return import_responses(mapping, [open_frf(path) for path in files], geometry)


def uff_file(tmp_path, campaign, values, coherence=None, **entries):
    path = tmp_path / "responses.unv"
    return write_uff(path, campaign.geometry.channel_names, COMPONENTS, FREQUENCY, values, coherence, **entries)


def response(transfer, component):
    return next(item for item in transfer.responses if item.components == (component,))


def misses(loads, campaign):
    """Errors of the harmonic loads of the check and the wind run over their sigma."""
    errors = []
    for run in loads.runs.values():
        cosine, sine = campaign.truths[run.run].harmonics(*run.interval)
        true = (cosine - 1j * sine)[1 : len(run.amplitude)]
        sigma = np.hypot(run.sigma_cosine, run.sigma_sine)[1:]
        errors.append(np.abs(run.amplitude[1:] - true) / sigma)
    return np.concatenate(errors).ravel()


@pytest.mark.parametrize("form", ["uff", "mat", "csv"])
def test_loads_by_imported_responses_are_true_within_their_sigma(tmp_path, campaign, calibration, truth, form):
    geometry, (_, values, coherence) = campaign.geometry, truth
    names = geometry.channel_names
    if form == "uff":
        file = uff_file(tmp_path, campaign, values, coherence)
        map_path = uff_map(tmp_path / "map.yaml", geometry, averages=AVERAGES)
    elif form == "mat":
        file = tmp_path / "responses.mat"
        single = values.transpose(1, 2, 0).astype(np.complex64)
        savemat(file, {"f": FREQUENCY, "frf": {"H": single, "g": coherence.transpose(1, 2, 0)}})
        array = {"value": "frf.H", "coherence": "frf.g", "responses": list(names), "references": list(COMPONENTS)}
        map_path = named_map(tmp_path / "map.yaml", geometry, frequency="f", arrays=[array], averages=AVERAGES)
    else:
        file, pairs = write_table(tmp_path / "responses.csv", names, values)
        map_path = named_map(tmp_path / "map.yaml", geometry, frequency="Frequency", pairs=pairs, window="none")
    transfer = imported(map_path, file, geometry=geometry)
    assert geometry_findings(transfer) == ()
    findings, text = static_findings(transfer, calibration, "cal.h5")
    assert findings == () and text.endswith("they agree")
    loads = reduction.reduce(campaign.runs_of_kind("check", "wind"), calibration, transfer)
    z = misses(loads, campaign)
    assert np.sqrt(np.mean(z**2)) < 1.5 and z.max() < 5.0
    own = reduction.reduce(campaign.runs_of_kind("check", "wind"), calibration, sweep_responses(campaign))
    for name, run in loads.runs.items():
        beside = own.runs[name]
        sigma = np.sqrt(sum(x.sigma_cosine**2 + x.sigma_sine**2 for x in (run, beside)))[1:]
        assert np.max(np.abs(run.amplitude - beside.amplitude)[1:] / sigma) < 5.0


def sweep_responses(campaign):
    return estimate_responses(campaign.runs, campaign.geometry)


def named_map(path, geometry, **entries):
    responses = {name: {"name": name, "unit": "V"} for name in geometry.channel_names}
    references = {name: {"component": name, "unit": "N" if name[0] == "F" else "N m"} for name in COMPONENTS}
    return write_map(path, geometry.rig, responses=responses, references=references, **entries)


def write_table(path, names, values):
    """Magnitude and phase in degrees of each pair, in columns."""
    columns, heads, pairs = [FREQUENCY], ["Frequency [Hz]"], []
    for j, component in enumerate(COMPONENTS):
        for i, name in enumerate(names):
            head = f"{name} over {component}"
            heads += [f"mag {head}", f"phase {head}"]
            columns += [np.abs(values[:, i, j]), np.degrees(np.angle(values[:, i, j]))]
            pairs.append({"response": name, "reference": component, "magnitude": heads[-2], "phase": heads[-1]})
    rows = [";".join(f"{x:.8e}" for x in row) for row in np.stack(columns, axis=1)]
    path.write_text("\n".join([";".join(heads), *rows]) + "\n")
    return path, pairs


def test_units_signs_and_lines_are_those_of_the_rig(tmp_path, campaign, truth):
    """Volts in mV over lbf, a force along -Z, two lines of zeros, and 0 Hz."""
    exact = truth[0]
    values = exact * 1e3 * 4.4482216152605
    values[:, :, 2] *= -1.0
    values[[40, 60]] = 0.0
    file = write_uff(tmp_path / "imperial.unv", campaign.geometry.channel_names[:PLATE], COMPONENTS[:3], FREQUENCY,
                     values[:, :PLATE, :3], units=("mV", "lbf"), signs={"Fz": -1})  # fmt: skip
    references = {"1+X": "Fx", "1+Y": "Fy", "1-Z": "Fz"}
    responses = {f"{11 + i}+Z": name for i, name in enumerate(campaign.geometry.channel_names[:PLATE])}
    map_path = write_map(tmp_path / "map.yaml", campaign.geometry.rig, responses=responses, references=references)
    transfer = imported(map_path, file, geometry=campaign.geometry)
    keep = np.setdiff1d(np.arange(len(FREQUENCY)), [0, 40, 60])
    for j, name in enumerate(COMPONENTS[:3]):
        found = response(transfer, name)
        np.testing.assert_allclose(found.frequency, FREQUENCY[keep])
        np.testing.assert_allclose(found.response[:, :, 0], exact[keep, :PLATE, j], rtol=1e-6, atol=1e-12)
    notes = " ".join(transfer.import_notes)
    for said in ("taken as -Fz", "1 line left out: 0 Hz", "2 lines left out: zero"):
        assert said in notes
    with pytest.raises(UserError, match="no response to Mx, My, Mz was measured"):
        reduction.reduce(campaign.runs_of_kind("wind"), None, transfer)


def test_cells_in_newtons_are_converted_by_their_sensitivity(tmp_path, campaign, truth):
    exact, geometry = truth[0], campaign.geometry
    cells = [i for i, channel in enumerate(geometry.channels) if channel.cell]
    sensitivity = np.array([geometry.channels[i].sensitivity for i in cells])
    names = tuple(geometry.channel_names[i] for i in cells)
    file = write_uff(tmp_path / "n.unv", names, COMPONENTS[:1], FREQUENCY, exact[:, cells, :1] / sensitivity[:, None],
                     quantity=(13, 13), units=("NONE", "NONE"))  # fmt: skip
    responses = {f"{11 + i}+Z": name for i, name in enumerate(names)}
    map_path = write_map(tmp_path / "map.yaml", geometry.rig, responses=responses, references={"1+X": "Fx"})
    found = response(imported(map_path, file, geometry=geometry), "Fx")
    np.testing.assert_allclose(found.response[:, :, 0], exact[1:, cells, 0], rtol=1e-9)


def test_forces_beside_the_hub_give_the_responses_to_hub_loads(tmp_path, campaign, truth):
    """Six stingers at two heights and arms: each drives several loads at once."""
    exact, geometry = truth[0], campaign.geometry
    hub = np.array(geometry.hub)
    points = [((0, 0, 0.1), (1, 0, 0)), ((0, 0, -0.1), (1, 0, 0)), ((0, 0, 0.1), (0, 1, 0)),
              ((0.2, 0, 0), (0, 1, 0)), ((0.2, 0.1, 0), (0, 0, -1)), ((-0.2, -0.1, 0), (0, 0, 1))]  # fmt: skip
    loads = np.array([[*d, *np.cross(p, d)] for p, d in points], float).T
    values = exact @ loads
    values[40, 3] = np.nan
    file = tmp_path / "taps.mat"
    savemat(file, {"f": FREQUENCY, "H": values})
    references = {f"p{k}": {"position": (hub + p).tolist(), "direction": list(map(float, d)), "unit": "N"}
                  for k, (p, d) in enumerate(points)}  # fmt: skip
    names = list(geometry.channel_names)
    map_path = write_map(
        tmp_path / "map.yaml", geometry.rig, references=references, frequency="f",
        responses={name: {"name": name, "unit": "V"} for name in names},
        arrays=[{"value": "H", "responses": names, "references": list(references)}],
    )  # fmt: skip
    (combined,) = imported(map_path, file, geometry=geometry).responses
    assert combined.components == COMPONENTS
    np.testing.assert_allclose(combined.frequency, np.delete(FREQUENCY, [0, 40]))
    np.testing.assert_allclose(combined.response, np.delete(exact, [0, 40], axis=0)[:, :PLATE], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "entries", "said"),
    [
        (np.conj, {}, "phases of the responses rise with frequency"),
        (lambda T: T * np.array([1, 1, -1, 1, 1, 1]), {}, "Fz"),
        (lambda T: T * np.array([1, 1, 4.448, 1, 1, 1]), {}, "Fz"),
        (lambda T: T, {"quantity": (11, 13), "units": ("m/s", "N")}, "is a mobility"),
        (lambda T: T, {"quantity": (8, 13), "units": ("NONE", "N")}, "is a receptance"),
        (lambda T: T, {"quantity": (0, 12), "units": ("V", "N")}, "is an acceleration, not a force"),
        (lambda T: T, {"units": ("NONE", "N")}, "unit of .* is not known"),
        (lambda T: T, {"units": ("V", "kg")}, "kg"),
    ],
)
def test_what_is_no_response_of_the_rig_is_refused(tmp_path, campaign, truth, change, entries, said):
    file = uff_file(tmp_path, campaign, change(truth[1]), **entries)
    with pytest.raises(UserError, match=said):
        geometry_findings(imported(uff_map(tmp_path / "map.yaml", campaign.geometry), file, geometry=campaign.geometry))


def test_conjugated_responses_are_turned_where_the_map_says_so(tmp_path, campaign, truth):
    file = uff_file(tmp_path, campaign, truth[0].conj())
    map_path = uff_map(tmp_path / "map.yaml", campaign.geometry, time_convention="exp(-jwt)")
    found = response(imported(map_path, file, geometry=campaign.geometry), "My")
    np.testing.assert_allclose(found.response[:, :, 0], truth[0][1:, :PLATE, 4], rtol=1e-9)


@pytest.mark.parametrize(("channel", "factor"), [("z1.strain", -1.0), ("x.strain", 3.0)])
def test_a_channel_that_is_not_that_of_the_calibration_is_refused(
    tmp_path, campaign, calibration, truth, channel, factor
):
    """All loads show it alike, and the redundancy cannot tell it from a property of the rig: the calibration can."""
    values = truth[1].copy()
    values[:, campaign.geometry.channel_names.index(channel)] *= factor
    transfer = imported(uff_map(tmp_path / "map.yaml", campaign.geometry), uff_file(tmp_path, campaign, values),
                        geometry=campaign.geometry)  # fmt: skip
    with pytest.raises(UserError, match=f"`{channel}`"):
        static_findings(transfer, calibration, "cal.h5")


def test_responses_that_begin_too_high_are_said_not_to_be_compared(tmp_path, campaign, calibration, truth):
    high = FREQUENCY > 30.0
    file = write_uff(
        tmp_path / "high.unv", campaign.geometry.channel_names, COMPONENTS, FREQUENCY[high], truth[1][high]
    )
    transfer = imported(uff_map(tmp_path / "map.yaml", campaign.geometry), file, geometry=campaign.geometry)
    findings, text = static_findings(transfer, calibration, "cal.h5")
    assert findings == () and "do not tell the response at rest" in text
    assert "give --calibration" in static_findings(transfer, None, "")[1]


def test_two_sided_responses_lose_their_conjugate_half(tmp_path, campaign, truth):
    exact, geometry = truth[0][1:], campaign.geometry
    frequency = np.concatenate([-FREQUENCY[:0:-1], FREQUENCY[1:]])
    for f, values in (
        (frequency, np.concatenate([exact[::-1].conj(), exact])),
        (np.arange(2 * len(FREQUENCY) - 1) * 0.25, np.concatenate([truth[0][:1].real, exact, exact[::-1].conj()])),
    ):
        savemat(tmp_path / "two.mat", {"f": f, "H": values})
        array = {"value": "H", "responses": list(geometry.channel_names), "references": list(COMPONENTS)}
        map_path = named_map(tmp_path / "map.yaml", geometry, frequency="f", arrays=[array])
        transfer = imported(map_path, tmp_path / "two.mat", geometry=geometry)
        np.testing.assert_allclose(response(transfer, "Fy").response[:, :, 0], exact[:, :PLATE, 1], rtol=1e-9)
        assert any("two-sided" in note for note in transfer.import_notes)


def test_lines_of_other_steps_are_refused_and_a_coarser_reference_is_not(tmp_path, campaign, truth):
    exact, geometry = truth[0], campaign.geometry
    names = geometry.channel_names
    first = write_uff(tmp_path / "a.unv", names[:3], COMPONENTS[:1], FREQUENCY, exact[:, :3, :1])
    other = write_uff(tmp_path / "b.unv", names[3:4], COMPONENTS[:1], FREQUENCY * 0.7, exact[:, 3:4, :1])
    responses = {name[:10]: name for name in names[:4]}
    map_path = write_map(tmp_path / "map.yaml", geometry.rig, responses=responses, references={"1+X": "Fx"})
    with pytest.raises(UserError, match="frequencies in common"):
        imported(map_path, first, other, geometry=geometry)
    second = write_uff(tmp_path / "b.unv", names[3:4], COMPONENTS[:1], FREQUENCY[2::2], exact[2::2, 3:4, :1])
    found = response(imported(map_path, first, second, geometry=geometry), "Fx")
    np.testing.assert_allclose(found.frequency, FREQUENCY[2::2])
    np.testing.assert_allclose(found.response[:, :, 0], exact[2::2, :4, 0], rtol=1e-9)


def test_the_command_writes_a_result_that_reduce_and_export_know(tmp_path, campaign, calibration, truth):
    from balance_cli.campaign.recording.run_file import write_run
    from balance_cli.campaign.rig.geometry_file import save_geometry

    save_geometry(tmp_path / "rig.yaml", campaign.geometry)
    save_artefact(
        tmp_path / "cal.h5",
        "balance-calibration/1",
        calibration,
        Provenance("a-test", {}, (), {}, "2026-01-02T03:04:05+00:00"),
    )
    write_run(tmp_path / "wind.h5", campaign.runs_of_kind("wind")[0])
    file = uff_file(tmp_path, campaign, truth[1], truth[2])
    map_path = uff_map(tmp_path / "map.yaml", campaign.geometry, averages=AVERAGES)
    g = ("-g", tmp_path / "rig.yaml", "--calibration", tmp_path / "cal.h5")
    said = call("import-frf", map_path, file, *g, "-o", tmp_path / "tf.h5")
    assert "sigma by the coherence of 50 averages" in said and "they agree" in said
    stored = load_artefact(tmp_path / "tf.h5", {"balance-transfer/1": Transfer})
    assert [item.role for item in stored.provenance.inputs][:3] == ["geometry", "map", "responses"]
    call("reduce", *g[2:], "--transfer", tmp_path / "tf.h5", tmp_path / "wind.h5", "-o", tmp_path / "loads.csv")
    call("report", tmp_path / "tf.h5", "-o", tmp_path / "page.html")
    call("export", tmp_path / "tf.h5", "-o", tmp_path / "again.uff")
    sketch = call("import-frf", "--sketch", tmp_path / "again.uff", *g[:2])
    assert "TODO" not in sketch
    (tmp_path / "map2.yaml").write_text(sketch)
    call("import-frf", tmp_path / "map2.yaml", tmp_path / "again.uff", *g[:2], "-o", tmp_path / "tf2.h5")
    again = load_artefact(tmp_path / "tf2.h5", {"balance-transfer/1": Transfer}).content
    np.testing.assert_allclose(
        response(again, "Mz").response, response(stored.content, "Mz").response, rtol=1e-9, atol=1e-20
    )
    refused = CliRunner().invoke(balance, ["import", "--sketch", str(file)])
    assert refused.exit_code == 2 and "balance import-frf" in refused.output


def call(*words):
    result = CliRunner().invoke(balance, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.output


def test_errors_name_what_is_missing(tmp_path, campaign, truth):
    file = uff_file(tmp_path, campaign, truth[0])
    map_path = uff_map(tmp_path / "map.yaml", campaign.geometry, references={"9+X": "Fx"})
    with pytest.raises(UserError, match="no function has the reference `9\\+X`"):
        imported(map_path, file, geometry=campaign.geometry)
    map_path = uff_map(tmp_path / "map.yaml", campaign.geometry, references={"1+X": "Fz"})
    with pytest.raises(UserError, match="along \\+X, that of the map along Z"):
        imported(map_path, file, geometry=campaign.geometry)
    with pytest.raises(UserError, match="second function"):
        imported(uff_map(tmp_path / "map.yaml", campaign.geometry), file, file, geometry=campaign.geometry)
    other = replace_rig(campaign.geometry)
    with pytest.raises(UserError, match="belongs to the rig"):
        imported(uff_map(tmp_path / "map.yaml", campaign.geometry), file, geometry=other)


def replace_rig(geometry):
    return geometry.model_copy(update={"rig": "another"})


def test_binary_universal_files_have_the_responses_of_written_ones(tmp_path, campaign, truth):
    names, values = campaign.geometry.channel_names[:3], truth[1][:, :3, :1]
    written = write_uff(tmp_path / "text.unv", names, COMPONENTS[:1], FREQUENCY, values)
    binary = write_binary_uff(tmp_path / "binary.unv", written, values[:, :, 0].T)
    responses = {f"{11 + i}+Z": name for i, name in enumerate(names)}
    map_path = write_map(tmp_path / "map.yaml", campaign.geometry.rig, responses=responses, references={"1+X": "Fx"})
    found = response(imported(map_path, binary, geometry=campaign.geometry), "Fx")
    np.testing.assert_allclose(found.response, values[1:], rtol=1e-12)
    np.testing.assert_allclose(found.frequency, FREQUENCY[1:])


def test_mat_files_of_version_7_3_are_read(tmp_path, campaign, truth):
    """HDF5 behind a user block of 512 bytes, dimensions in reverse, complex numbers as pairs."""
    names, values = campaign.geometry.channel_names[:4], truth[1][:, :4, :2]
    path = tmp_path / "responses.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, data in (("f", FREQUENCY[None]), ("H", values.T)):
            if np.iscomplexobj(data):
                pairs = np.zeros(data.shape, [("real", "f8"), ("imag", "f8")])
                pairs["real"], pairs["imag"] = data.real, data.imag
                data = pairs
            file.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM")
    array = {"value": "H", "responses": list(names), "references": list(COMPONENTS[:2])}
    map_path = write_map(
        tmp_path / "map.yaml", campaign.geometry.rig, frequency="f", arrays=[array],
        responses={name: {"name": name, "unit": "V"} for name in names},
        references={name: {"component": name, "unit": "N"} for name in COMPONENTS[:2]},
    )  # fmt: skip
    transfer = imported(map_path, path, geometry=campaign.geometry)
    for j, name in enumerate(COMPONENTS[:2]):
        np.testing.assert_allclose(response(transfer, name).response[:, :, 0], values[1:, :, j], rtol=1e-12)


@pytest.mark.parametrize("window", ["none", "hann", "flattop"])
def test_sigma_of_windowed_responses_is_their_scatter(window):
    """Lines of a window share noise: the scatter tells it, and the share of independent lines is that of the window."""
    terms = np.array(WINDOW_TERMS[window])
    kernel = np.concatenate([terms[:0:-1], terms])
    rng = np.random.default_rng(5)
    k, c, averages = 600, 8, 200
    load, *noises = (windowed_noise(rng, averages, k, kernel) for _ in range(c + 1))
    error = np.mean(np.stack(noises, axis=2) * load.conj()[:, :, None], axis=0)
    frequency = 5.0 + 0.25 * np.arange(k)
    exact = 1.0 / (1.0 - (frequency[:, None] / np.linspace(300.0, 400.0, c)) ** 2)
    variance = scatter_variance(frequency, exact + 1e-3 * error, window)
    assert np.sqrt(np.median(variance)) == pytest.approx(1e-3 / np.sqrt(averages), rel=0.25)
    angle = 2.0 * np.pi * np.arange(4096) / 4096
    w = terms[0] + 2.0 * terms[1:] @ np.cos(np.outer(np.arange(1, len(terms)), angle))
    assert independent_share(window) == pytest.approx(np.sum(w**2) ** 2 / (len(w) * np.sum(w**4)), rel=1e-9)


def windowed_noise(rng, segments, lines, kernel):
    """Spectra (segments, lines) of noise of unit power, each line with its neighbors as a window has them."""
    shape = (segments, lines + len(kernel) - 1)
    white = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0 * np.sum(kernel**2))
    return sum(term * white[:, i : i + lines] for i, term in enumerate(kernel))


def test_a_channel_of_zeros_has_a_note(tmp_path, campaign, truth):
    names, values = campaign.geometry.channel_names[:3], truth[1][:, :3, :1].copy()
    values[:, 2] = 0.0
    file = write_uff(tmp_path / "zeros.unv", names, COMPONENTS[:1], FREQUENCY, values, truth[2][:, :3, :1])
    responses = {f"{11 + i}+Z": name for i, name in enumerate(names)}
    map_path = write_map(tmp_path / "map.yaml", campaign.geometry.rig, responses=responses, references={"1+X": "Fx"},
                         averages=AVERAGES)  # fmt: skip
    transfer = imported(map_path, file, geometry=campaign.geometry)
    assert any(f"`{names[2]}` zero at all lines: not measured" in note for note in transfer.import_notes)
    (note,) = sigma_notes(transfer)
    assert f"sigma by the coherence of {AVERAGES} averages" in note


def test_reduce_says_where_sigma_of_imported_responses_comes_from(tmp_path, campaign):
    notes = ("taken as -Fz", "`1-Z`: sigma by the coherence of 30 averages")
    transfer = replace(sweep_responses(campaign), import_notes=notes)
    save_artefact(tmp_path / "tf.h5", "balance-transfer/1", transfer, Provenance("test", {}, (), {}, ""))
    write_run(tmp_path / "wind.h5", campaign.runs_of_kind("wind")[0])
    call = ["reduce", "--transfer", str(tmp_path / "tf.h5"), str(tmp_path / "wind.h5"), "-o", str(tmp_path / "l.csv"),
            "--interpolation", "nearest"]  # fmt: skip
    result = CliRunner().invoke(balance, [*call, "--json", str(tmp_path / "l.json")])
    assert result.exit_code == 0, result.output
    assert f"response: {notes[1]}" in result.output
    assert json.loads((tmp_path / "l.json").read_text())["response_notes"] == [notes[1]]
