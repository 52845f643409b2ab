"""A rig for the tests of the simulation: seven cells, one channel of each kind."""

import yaml

from balance_cli.campaign.rig.geometry import Geometry

RIG = """
format: balance-geometry/1
name: v1
rig: R
hub: [0.01, -0.02, 0.7]
bodies:
- {name: plate, mass: 60, position: [0, 0, 0], inertia: {xx: 2.0, yy: 3.0, zz: 4.8, xy: 0.1, xz: -0.2, yz: 0.05}}
- {name: mast, mass: 40, position: [-0.05, 0.02, 0.4], inertia: {xx: 1.0, yy: 1.2, zz: 0.4, xz: 0.1}}
cells:
- {name: x, position: [0.02, 0.0, -0.05], axis: [2, 0, 0], stiffness: 3.0e6, full_range: 5000}
- {name: y1, position: [0.3, 0.03, -0.05], axis: [0, 1, 0], stiffness: 2.4e6, full_range: 5000}
- {name: y2, position: [-0.33, -0.02, -0.05], axis: [0, 1, 0], series: [4.6e6, 4.6e6], full_range: 5000}
- {name: z1, position: [0.36, 0.27, -0.06], axis: [0, 0, 1], stiffness: 5.1e6, full_range: 5000}
- {name: z2, position: [0.36, -0.27, -0.06], axis: [0, 0, 1], stiffness: 5.0e6, full_range: 5000}
- {name: z3, position: [-0.36, -0.27, -0.06], axis: [0, 0, 1], stiffness: 5.2e6, full_range: 5000}
- {name: z4, position: [-0.36, 0.27, -0.06], axis: [0, 0, 1], stiffness: 4.9e6, full_range: 5000}
torque_meter: {stiffness: 9.0e4, inertia: 0.65}
channels:
- {name: torque, torque_meter: true, sensitivity: 0.02}
- {name: z1.strain, cell: z1, sensitivity: 0.002, lowpass: 90}
- {name: y2.piezo, cell: y2, sensitivity: -0.01, time_constant: 0.1}
- {name: x.strain, cell: x, sensitivity: 0.002}
acquisition: {filter: {type: butterworth, order: 5, cutoff: 180}}
damping_ratio: 0.02
tolerances: {stiffness: 0.05, mass: 0.02, centre_of_gravity: 0.005, inertia: 0.1, damping_ratio: 0.5, sensitivity: 0.01}
rotor: {blades: 4, speed: 17.5}
"""


def rig_geometry(**changes) -> Geometry:
    return Geometry(**{**yaml.safe_load(RIG), **changes})


GEOMETRY = rig_geometry()
