"""Settings of integration and contacts: default plant and held-out plant for evaluation.

A policy that works on one plant only may have learned that plant's contacts. The held-out plant
changes the properties that no data sheet states.
"""

from __future__ import annotations

import attrs
import mujoco

from quadvel_description.fields import field
from quadvel_description.quadruped import LEGS

CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}


@attrs.frozen
class Physics:
    """MuJoCo settings that differ from the model of the robot; the defaults change nothing.

    Attributes:
        substeps: Physics steps per millisecond; torques are constant in between.
        cone: Shape of the friction cone; a pyramid lets feet creep sideways.
        contact_time: Time constant of contacts, s; a shorter one makes contacts stiffer.
        contact_damping: Damping ratio of contacts.
        torsional_friction: Torsional friction coefficient of the feet, m: a turning foot is braked
            with this times its load; 0: none.
        inertia: Factor of the inertia of every link.
        mass: Factor of the mass of every link, without unit; 1 is the robot as described.
    """

    substeps: int = field(1, at_least=0, whole=True)
    cone: str = field("elliptic", one_of=CONES)
    contact_time: float = field(0.01, at_least=0.002, at_most=0.1)
    contact_damping: float = field(1.0, at_least=0.1, at_most=5.0)
    torsional_friction: float = field(0.0, at_least=0.0, at_most=0.1)
    inertia: float = field(1.0, at_least=0.5, at_most=2.0)
    mass: float = field(1.0, at_least=0.5, at_most=2.0)

    def apply(self, model: mujoco.MjModel) -> None:
        """Apply the settings to a compiled model of the robot.

        Args:
            model: Model that is changed in place.
        """
        if self == Physics():
            return
        model.opt.timestep /= self.substeps
        model.opt.cone = CONES[self.cone]
        for leg in LEGS:
            foot = model.geom(f"{leg}_foot")
            foot.solref[:] = self.contact_time, self.contact_damping
            if self.torsional_friction:
                foot.condim[0] = 4
                foot.friction[1] = self.torsional_friction
        model.body_mass[:] *= self.mass
        model.body_inertia[:] *= self.inertia
        mujoco.mj_setConst(model, mujoco.MjData(model))


HELD_OUT_PHYSICS = Physics(
    substeps=2,
    cone="pyramidal",
    contact_time=0.005,
    contact_damping=0.8,
    torsional_friction=0.01,
    inertia=1.15,
    mass=1.03,
)
"""Held-out plant: policies are evaluated on it in addition to the default plant."""
