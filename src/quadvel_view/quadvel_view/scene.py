"""3-D scene of the robot and its surroundings, on a viser server. It has no controls.

The robot stays at the origin and the world moves, so that the orbiting camera needs no updates.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import attrs
import numpy as np
import trimesh
import viser

from quadvel_description.arrays import Array
from quadvel_description.frames import moving_links
from quadvel_description.robot import Robot

from .picture import Ground, Person, RobotPicture

Colour = tuple[int, int, int]

TRUNK, LEG, FOOT = (226, 230, 236), (84, 93, 107), (255, 128, 48)
BACKGROUND: Colour = (14, 17, 22)
GRID, GRID_SECTION = (38, 44, 54), (58, 67, 80)
GROUND: Colour = (58, 66, 72)
SCAN, TRAIL, PATH = (64, 196, 255), (72, 110, 150), (120, 230, 140)
PERSON_HEIGHT_M, PERSON_RADIUS_M = 1.7, 0.2
"""Size of the column that represents a person."""
CORNER_RADIUS_M = 0.012
"""Radius of the rounded edges of boxes, which make shading visible."""
LIFT_SMOOTHING = 0.15
"""Share of the height error corrected per frame.

It is low, because feet leave the ground in a flight phase.
"""
LINE_OFFSET_M = 0.006
"""Height of lines above the ground that they lie on."""
CAMERA_POSITION_M = (1.2, -1.3, 0.6)
"""Initial position of the camera relative to the robot."""


@attrs.frozen
class Shape:
    """A visible part of a link.

    Attributes:
        link: Name of the link.
        mesh: Its mesh in the frame of the link, m.
        colour: Red, green, blue, 0 to 255.
    """

    link: str
    mesh: trimesh.Trimesh
    colour: Colour


class Scene:
    """The nodes of the scene. Unchanged objects are not sent again.

    Args:
        server: The viser server.
        robot: The robot.
    """

    def __init__(self, server: viser.ViserServer, robot: Robot) -> None:
        self._server, scene = server, server.scene
        scene.set_up_direction("+z")
        server.initial_camera.position = CAMERA_POSITION_M
        server.initial_camera.look_at = (0.0, 0.0, -0.05)
        server.initial_camera.fov = 0.75
        _configure_appearance(server)
        self._world = scene.add_frame("/world", show_axes=False)
        self._base = scene.add_frame("/robot", show_axes=False)
        self._robot = robot
        self._links = self._add_links()
        self._grid = scene.add_grid(
            "/grid",
            infinite_grid=True,
            cell_color=GRID,
            section_color=GRID_SECTION,
            cell_size=0.25,
            section_size=1.0,
            fade_distance=14.0,
            shadow_opacity=0.35,
        )
        self._drift = 0.0  # m, smoothed height error of the odometry
        self._floor = 0.0  # m, smoothed height of the ground below the robot, frame odom
        self._drawn: dict[str, Any] = {}
        self._persons: dict[int, Any] = {}

    def draw(self, picture: RobotPicture) -> None:
        """Draw a picture.

        Args:
            picture: The state of the robot.
        """
        x, y, z = picture.position.tolist()
        # First-order low pass of the ground's height and of the odometry's height error.
        floor, above = picture.ground_below_feet()
        self._floor += LIFT_SMOOTHING * (floor - self._floor)
        self._drift += LIFT_SMOOTHING * (above - self._drift)
        standing = self._robot.nominal_height
        height = z - self._drift - self._floor - standing
        with self._server.atomic():
            self._base.position, self._base.wxyz = (0.0, 0.0, height), picture.quaternion
            self._world.position = (-x, -y, -self._floor - standing)
            self._grid.position = (-x % 1.0, -y % 1.0, -standing)
            for placed in moving_links(self._robot, picture.q):
                self._links[placed.child].wxyz = placed.quaternion
            self._draw_world(picture)

    def _draw_world(self, picture: RobotPicture) -> None:
        """Draw everything that changed around the robot."""
        if self._is_new("ground", picture.ground):
            self._draw_ground(picture.ground)
        if self._is_new("scan", picture.scan):
            self._server.scene.add_point_cloud(
                "/world/scan", picture.scan, SCAN, point_size=0.035, point_shape="circle", precision="float32"
            )
        if self._is_new("trail", picture.trail[-1] if picture.trail else None):
            self._draw_line("/world/trail", np.array(picture.trail).reshape(-1, 3), TRAIL)
        if self._is_new("path", picture.path):
            self._draw_line("/world/path", picture.path, PATH)
        if self._is_new("persons", picture.persons):
            self._draw_persons(picture)

    def _draw_ground(self, ground: Ground | None) -> None:
        """Draw the ground mesh, or a grid if it is flat."""
        self._grid.visible = ground is None
        if ground is None:
            self._server.scene.remove_by_name("/world/ground")
            return
        faces = np.arange(len(ground.vertices)).reshape(-1, 3)
        merged = trimesh.Trimesh(ground.vertices, faces)  # merges vertices, for smooth shading
        self._server.scene.add_mesh_simple(
            "/world/ground", merged.vertices, merged.faces, color=GROUND, side="double", cast_shadow=False
        )

    def _draw_line(self, name: str, points: Array, colour: Colour) -> None:
        """Draw a polyline on the ground, or remove it if it has no segment."""
        if len(points) < 2:
            self._server.scene.remove_by_name(name)
            return
        segments = np.stack([points[:-1], points[1:]], axis=1) + np.array([0.0, 0.0, LINE_OFFSET_M])
        self._server.scene.add_line_segments(name, segments, colour, thickness=2.5, thickness_units="screen")

    def _draw_persons(self, picture: RobotPicture) -> None:
        """Draw a column per person in the colour of the track, with its number above."""
        now = {person.id: person for person in picture.persons}
        for gone in self._persons.keys() - now.keys():
            self._persons.pop(gone).remove()
        for number, person in now.items():
            if number not in self._persons:
                self._persons[number] = self._add_person(person)
            self._persons[number].position = (*person.position.tolist(), 0.5 * PERSON_HEIGHT_M)

    def _add_person(self, person: Person) -> Any:
        """Add the column and the label of a person."""
        name = f"/world/person_{person.id}"
        handle = self._server.scene.add_cylinder(
            name, PERSON_RADIUS_M, PERSON_HEIGHT_M, person.colour, opacity=0.65
        )
        self._server.scene.add_label(f"{name}/id", str(person.id), position=(0.0, 0.0, 0.6 * PERSON_HEIGHT_M))
        return handle

    def _is_new(self, name: str, what: Any) -> bool:
        """Return whether this is another object than the last one under this name."""
        before = self._drawn.get(name)
        self._drawn[name] = what
        return before is not what

    def _add_links(self) -> dict[str, Any]:
        """Add a frame per moving link in that of its parent, with the meshes of the link."""
        scene, names, frames = self._server.scene, {"base_link": "/robot"}, {}
        for link in self._robot.links:
            names[link.name] = f"{names[link.parent or 'base_link']}/{link.name}"
            frames[link.name] = scene.add_frame(names[link.name], show_axes=False, position=link.origin)
        for number, shape in enumerate(robot_shapes(self._robot)):
            scene.add_mesh_simple(
                f"{names[shape.link]}/shape_{number}",
                shape.mesh.vertices,
                shape.mesh.faces,
                color=shape.colour,
            )
        return frames


def robot_shapes(robot: Robot) -> Iterator[Shape]:
    """Yield the visual shapes of the robot's URDF.

    Args:
        robot: The robot.

    Yields:
        One shape per visual element.
    """
    for link in ElementTree.parse(robot.urdf_file).iter("link"):
        for visual in link.iter("visual"):
            geometry = visual.find("geometry/*")
            assert geometry is not None
            mesh = _mesh(geometry)
            origin = visual.find("origin")
            assert origin is not None
            mesh.apply_transform(_transform(origin))
            name = link.get("name", "")
            colour = TRUNK if name == "trunk" else FOOT if name.endswith("foot") else LEG
            yield Shape(name, mesh, colour)


def _mesh(geometry: ElementTree.Element) -> trimesh.Trimesh:
    """Build the mesh of a URDF geometry; boxes get rounded edges."""
    sizes = {key: np.array(value.split(), float) for key, value in geometry.items()}
    if geometry.tag == "box":
        corner = min(CORNER_RADIUS_M, 0.45 * sizes["size"].min())
        centres = trimesh.creation.box(sizes["size"] - 2 * corner).vertices
        ball = trimesh.creation.icosphere(subdivisions=2, radius=corner)
        return trimesh.convex.convex_hull((centres[:, None] + ball.vertices).reshape(-1, 3))
    if geometry.tag == "cylinder":
        return trimesh.creation.cylinder(float(sizes["radius"][0]), float(sizes["length"][0]), sections=40)
    return trimesh.creation.icosphere(subdivisions=3, radius=float(sizes["radius"][0]))


def _transform(origin: ElementTree.Element) -> Array:
    """Convert a URDF origin to a homogeneous transform (4, 4)."""
    place, angles = (np.array(origin.get(key, "0 0 0").split(), float) for key in ("xyz", "rpy"))
    matrix: Array = trimesh.transformations.euler_matrix(*angles)  # type: ignore[no-untyped-call]
    matrix[:3, 3] = place
    return matrix


def _configure_appearance(server: viser.ViserServer) -> None:
    """Set light and background, and hide viser's controls."""
    scene = server.scene
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.set_background_image(np.full((1, 1, 3), BACKGROUND, np.uint8))
    scene.configure_fog(6.0, 16.0, color=BACKGROUND)
    scene.add_light_hemisphere(
        "/light/sky", sky_color=(215, 228, 255), ground_color=(52, 50, 48), intensity=1.6
    )
    scene.add_light_directional(
        "/light/sun", color=(255, 244, 228), intensity=2.4, cast_shadow=True, position=(1.5, -2.0, 4.0)
    )
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
