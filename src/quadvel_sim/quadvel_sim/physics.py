"""How a simulator solves motion and contact: the plant that everything was made on, and a second one to judge on.

A policy that is good on one plant alone has learned that plant's contacts. The second one differs in what no data sheet says.
"""

from __future__ import annotations

import attrs
import mujoco

from quadvel_description import robot
from quadvel_sim.checks import number, whole_number

CONES = {"elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC, "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL}


@attrs.frozen
class Physics:
    """MuJoCo's settings beyond the robot's own description, which the defaults leave as they are."""

    substeps: int = attrs.field(default=1, **whole_number())
    """Steps of the physics in a millisecond; torques are held in between."""
    cone: str = attrs.field(default="elliptic", validator=attrs.validators.in_(CONES))
    """Shape of the friction cone; a pyramid lets feet creep sideways."""
    contact_time: float = attrs.field(default=0.01, **number(0.002, 0.1))
    """Time constant of contacts, s: the shorter, the stiffer."""
    contact_damping: float = attrs.field(default=1.0, **number(0.1, 5.0))
    """Damping ratio of contacts."""
    torsional_friction: float = attrs.field(default=0.0, **number(0.0, 0.1))
    """Of the feet, m: turning on the spot costs this times the load. 0: none."""
    inertia: float = attrs.field(default=1.0, **number(0.5, 2.0))
    """Of every link, as a share of what the model says."""
    mass: float = attrs.field(default=1.0, **number(0.5, 2.0))
    """Of every link, the same."""

    def apply(self, model: mujoco.MjModel) -> None:
        """Put these into a compiled model of the robot."""
        if self == Physics():
            return
        model.opt.timestep /= self.substeps
        model.opt.cone = CONES[self.cone]
        for leg in robot.LEGS:
            foot = model.geom(f"{leg}_foot")
            foot.solref[:] = self.contact_time, self.contact_damping
            if self.torsional_friction:
                foot.condim[0] = 4
                foot.friction[1] = self.torsional_friction
        model.body_mass[:] *= self.mass
        model.body_inertia[:] *= self.inertia
        mujoco.mj_setConst(model, mujoco.MjData(model))


SECOND = Physics(
    substeps=2,
    cone="pyramidal",
    contact_time=0.005,
    contact_damping=0.8,
    torsional_friction=0.01,
    inertia=1.15,
    mass=1.03,
)
"""The plant that policies are judged on beside the usual one."""
