"""Mass, stiffness and load matrices against closed forms, the paper and the corrections to it."""

import numpy as np
import pytest

from balance_cli.campaign.rig.kinematics import elongation_matrix, motion_at
from balance_cli.campaign.rig.load_components import carried_components
from balance_cli.campaign.rig.mass_properties import metric_side
from balance_cli.model.plate import load_matrix, mass_matrix, moment_reference_length, plate_matrices
from tests.support.rigs import one_degree_of_freedom, rotor_balance, two_degrees_of_freedom


def test_motion_of_a_point_is_the_papers():
    xi, eta, zeta = 0.3, -0.2, 0.7
    q = np.array([1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3])
    x, y, z, psi, theta, phi = q
    expected = [x + theta * zeta - psi * eta, y + psi * xi - phi * zeta, z + phi * eta - theta * xi]
    np.testing.assert_allclose(motion_at(np.array([xi, eta, zeta])) @ q, expected, rtol=1e-14)


def test_metric_side_of_two_point_masses():
    rig = one_degree_of_freedom(
        bodies=[
            {"name": "a", "mass": 1.0, "position": [0.0, 0.0, 0.0], "inertia": {"xx": 0, "yy": 0, "zz": 0}},
            {"name": "b", "mass": 3.0, "position": [0.4, 0.2, 0.0], "inertia": {"xx": 0, "yy": 0, "zz": 0}},
            {"name": "rod", "mass": 1.0, "position": [0.3, 0.15, 0.0], "inertia": {"xx": 1, "yy": 1, "zz": 1}},
        ]
    )
    part = metric_side(rig)
    assert part.mass == pytest.approx(5.0)
    np.testing.assert_allclose(part.centre_of_gravity, [0.3, 0.15, 0.0], atol=1e-15)
    # Products are positive integrals of xy dm, and enter the tensor with a minus sign.
    product = 1.0 * 0.3 * 0.15 + 3.0 * 0.1 * 0.05
    assert -part.inertia[0, 1] == pytest.approx(product)
    assert part.inertia[0, 0] == pytest.approx(1.0 + 0.15**2 + 3 * 0.05**2)


def test_kinetic_energy_of_the_mass_matrix():
    inertia = np.array([[2.0, -0.3, 0.1], [-0.3, 3.0, 0.2], [0.1, 0.2, 4.0]])
    velocity, spin = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.2, -0.7])
    q = np.concatenate([velocity, spin[::-1]])
    energy = 0.5 * 7.0 * velocity @ velocity + 0.5 * spin @ inertia @ spin
    assert 0.5 * q @ mass_matrix(7.0, inertia) @ q == pytest.approx(energy)


def test_load_matrix_is_the_virtual_work_of_the_hub_loads():
    rig = rotor_balance()
    centre = metric_side(rig).centre_of_gravity
    loads = np.array([10.0, -20.0, 30.0, 4.0, 5.0, 0.0])
    q = np.array([1.0, 2.0, 3.0, 0.4, 0.5, 0.6])
    displacement = motion_at(np.asarray(rig.hub) - centre) @ q
    work = loads[:3] @ displacement + loads[3] * q[5] + loads[4] * q[4]
    assert load_matrix(rig, centre) @ loads @ q == pytest.approx(work)
    assert not load_matrix(rig, centre)[:, 5].any()


def test_eigenfrequencies_of_heave_and_pitch():
    plate = plate_matrices(two_degrees_of_freedom())
    np.testing.assert_allclose(np.diag(plate.K), [2e6, 2e6 * 0.3**2])
    np.testing.assert_allclose(np.diag(plate.M), [20.0, 0.8])
    assert plate.K[0, 1] == pytest.approx(0.0, abs=1e-6)


def test_second_eigenfrequency_of_the_sample_balance_is_that_of_the_reading_notes():
    plate = plate_matrices(rotor_balance())
    eigenvalues = np.linalg.eigvals(np.linalg.solve(plate.M, plate.K)).real
    frequency = np.sort(np.sqrt(eigenvalues)) / (2 * np.pi)
    assert frequency[1] == pytest.approx(25.3, abs=0.01)


def test_static_cell_forces_are_in_equilibrium_with_the_load():
    rig = rotor_balance()
    plate = plate_matrices(rig)
    forces = plate.C[:, None] * plate.B @ np.linalg.solve(plate.K, plate.F)
    axes = np.array([cell.direction for cell in rig.cells])
    np.testing.assert_allclose(axes.T @ forces, np.eye(3, 6), atol=1e-12)


def test_cell_and_beam_in_series():
    cell = {"name": "z", "position": [0, 0, 0], "axis": [0, 0, 1], "full_range": 1.0}
    rig = one_degree_of_freedom(cells=[{**cell, "series": [3e6, 6e6]}])
    assert plate_matrices(rig).C[0] == pytest.approx(2e6)


def test_carried_components_follow_the_freedom():
    assert carried_components(one_degree_of_freedom()) == ("Fz",)
    assert carried_components(two_degrees_of_freedom()) == ("Fz", "My")
    assert carried_components(rotor_balance()) == ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def test_an_inclined_cell_measures_along_its_axis():
    cell = {"name": "z", "position": [0, 0, 0], "axis": [1, 0, 1], "stiffness": 1.0, "full_range": 1.0}
    row = elongation_matrix(one_degree_of_freedom(cells=[cell]), np.zeros(3))[0]
    np.testing.assert_allclose(row[:3], np.array([1, 0, 1]) / np.sqrt(2))


@pytest.mark.parametrize(
    ("hub", "length"),
    [
        ([0.0, 0.0, 0.78], 0.78),
        ([0.01, -0.02, -0.7], 0.7),
        ([0.0, 0.25, 0.0], 0.25),
        ([0.0, 0.25, 0.002], 0.25),
        ([2.5, -0.4, 0.05], 2.532),
        ([0.0, 0.0, 0.0], 1.0),
    ],
)
def test_moments_are_compared_over_the_height_of_the_hub_or_its_distance_beside_the_plate(hub, length):
    """An axis along y has its hub at any height: with 2 mm, a moment of 2 N mm had been as large as a force of 1 N."""
    assert moment_reference_length(hub) == pytest.approx(length, rel=1e-3)
