"""A simulated campaign with a point mass that nobody declared."""

from __future__ import annotations

from balance_cli.campaign.rig.geometry import DeclaredEffect
from balance_cli.diagnosis.search.candidates import candidate_at
from balance_cli.diagnosis.search.extended_models import add_candidates, extend_model
from balance_cli.diagnosis.search.point_mass import place_mass_candidates
from balance_cli.diagnosis.selection.fit import fit_all_lines
from balance_cli.diagnosis.settings import DEFAULT_SETTINGS as SETTINGS
from balance_cli.estimation.measured_spectra import measured_spectra
from balance_cli.estimation.measurements import stack_runs
from balance_cli.model.balance import balance_model
from balance_cli.simulation import CampaignPlan, SweepPlan, simulate_campaign, true_rig
from balance_cli.simulation.preset_plans import HIGH_SWEEP_LEVELS, static_plans
from balance_cli.simulation.rig import apply_effects
from tests.support.rigs import rotor_balance

DECLARED = rotor_balance()
PLACE = (-0.2, 0.2, 0.3)


WEIGHED = DECLARED.model_copy(
    update={"tolerances": DECLARED.tolerances.model_copy(update={"mass": 0, "centre_of_gravity": 0, "inertia": 0})}
)
"""The same with mass, centre of gravity and inertia known exactly: nothing else does what a mass does."""


class Campaign:
    """Short sweeps and static runs of a rig with a mass that its geometry does not have, and the fit without it."""

    def __init__(self, geometry, mass, place=PLACE, seed=4):
        at = dict(zip("xyz", place, strict=True))
        rig = apply_effects(true_rig(DECLARED), [DeclaredEffect(name="added-mass", parameters={"mass": mass, **at})])
        sweeps = (
            SweepPlan(run=f"sweep-{name}", excited=(name,), level=(level,), period=1.0, periods=8)
            for name, level in HIGH_SWEEP_LEVELS.items()
        )
        runs, _ = simulate_campaign(rig, CampaignPlan(runs=(*static_plans(), *sweeps)), seed=seed)
        spectra = measured_spectra(runs, geometry, means=True)
        self.geometry, self.mass = geometry, mass
        self.batches = stack_runs(spectra.lines, spectra.statics, geometry.channel_names)
        model = balance_model(geometry)
        self.fit = fit_all_lines(model.at(), self.batches, SETTINGS.fit)

    def placed(self):
        """The candidate, begun where a mass gains most."""
        one = candidate_at("added-mass", (), self.geometry)
        return place_mass_candidates([one], self.fit, self.batches, SETTINGS)[0]

    def begun_at(self, number):
        """The model with the mass in it, and where it begins: no mass, at the place of this start."""
        return extend_model(self.fit, add_candidates(self.geometry, [(self.placed(), number)]))

    def fit_from_the_truth(self):
        start = self.begun_at(0)
        start.theta[mass_and_place(start.model)] = (self.mass, *PLACE)
        return fit_all_lines(start, self.batches, SETTINGS.fit)


def mass_and_place(model):
    return [model.parameters.index(f"added-mass.{name}") for name in ("mass", "x", "y", "z")]
