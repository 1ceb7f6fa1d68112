"""The workspace in three dimensions: cameras, what is known, what is next, and how uncertain each place is."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from implicam.active import Loop
from implicam.dataset import Floats
from implicam.drawing import WHITE
from implicam.images import eight_bit, opencv
from implicam.session.controller import State
from implicam.viewer.legend import EXCESS, EXCESS_SCALE, U95, line
from implicam.viewer.pictures import BALL, GREY, TARGET
from implicam.viewer.space import Eye, Placing, Scale, edges, eyes, upwards, vantage

if TYPE_CHECKING:
    import viser

THUMB = 200
"""Pixels: width of a picture in a frustum."""

NOTHING = np.zeros((0, 3))


class Scene:
    """The 3D part of the page; one thread draws it."""

    def __init__(self, server: viser.ViserServer, loop: Loop) -> None:
        self._server, self._scene, self._loop = server, server.scene, loop
        self._eyes: list[Eye] = []
        self._placing = Placing.of(loop.workspace, upwards([]))
        self._frusta: dict[str, Any] = {}
        self._drawn: dict[str, Any] = {}
        self.scale: Scale | None = None
        self.shown = U95
        self.aspect = 0.5  # of the scene's part of the window: browsers tell late when it has changed
        self._scene.configure_default_lights(True)
        self._room()

    def draw(self, state: State, measured: Floats, skipped: Floats) -> None:
        """What changed since the last time. measured: (3,) the ball as the cameras see it, NaN where they do not;
        skipped: (n, 3) targets that were left out."""
        with self._server.atomic():
            if self._changed("calibration", state.calibration):
                self._cameras(state)
            if self._changed("known", state.data, len(skipped)):
                self._points("known", NOTHING if state.data is None else state.data.xyz, WHITE, "circle")
                self._points("skipped", skipped, GREY, "diamond")
            if self._changed("predicted", state.predicted, self.shown):
                self._cloud(state)
            if self._changed("target", state.target):
                self._target(state)
            here = measured if np.isfinite(measured).all() and state.phase == "aim" else state.position
            if self._changed("ball", here.tobytes()):
                self._ball(here)
            if self._changed("looks", state.looks):
                self._pictures(state)

    def aim(self, client: viser.ClientHandle) -> None:
        """Turn a person's view so that everything is in it."""
        camera = client.camera
        position, at = vantage(self._eyes, self._loop.workspace.vertices, self._placing, self.aspect, camera.fov)
        with client.atomic():
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.position = position
            camera.look_at = at

    def redraw(self) -> None:
        """Draw everything at the next `draw`."""
        self._drawn.clear()

    def _changed(self, what: str, *values: Any) -> bool:
        """Whether these are others than the last time; arrays and their like are others when they are new."""
        before = self._drawn.get(what, ())
        self._drawn[what] = values
        plain = (int, str, bytes)
        return len(before) != len(values) or not all(
            a is b or (isinstance(a, plain) and isinstance(b, plain) and a == b)
            for a, b in zip(before, values, strict=True)
        )

    def _room(self) -> None:
        """The workspace's edges, and which way x, y and z go."""
        lines = self._placing.place(edges(self._loop.workspace))
        self._scene.add_line_segments(
            "/workspace", lines, np.full(lines.shape, 150, np.uint8), thickness=2.0, thickness_units="screen"
        )
        corner = self._loop.workspace.vertices.min(axis=0)
        arm = 0.15 * self._loop.workspace.size
        ends = corner + arm * np.eye(3)
        arrows = self._placing.place(np.stack([np.broadcast_to(corner, (3, 3)), ends], axis=1))
        colours = np.array([(230, 90, 80), (90, 200, 110), (100, 150, 255)], np.uint8)
        self._scene.add_arrows("/axes", arrows, colours, shaft_radius=0.008, head_radius=0.022, head_length=0.05)
        for axis, end in zip("xyz", self._placing.place(corner + 1.2 * arm * np.eye(3)), strict=True):
            self._scene.add_label(f"/axis/{axis}", axis, position=end, font_screen_scale=0.8)

    def _cameras(self, state: State) -> None:
        """New frusta; the first time, everybody's view too."""
        before = bool(self._eyes)
        self._eyes = eyes(state.calibration)
        if self._eyes and not before:
            self._placing = Placing.of(self._loop.workspace, upwards(self._eyes))
            self.redraw()
            self._drawn["calibration"] = (state.calibration,)
            self._room()
            for client in self._server.get_clients().values():
                self.aim(client)
        for name in set(self._frusta) - {eye.name for eye in self._eyes}:
            self._frusta.pop(name).remove()
        for eye in self._eyes:
            self._frustum(eye)

    def _frustum(self, eye: Eye) -> None:
        import viser.transforms as tf

        turned = tf.SO3.from_matrix(self._placing.rotation @ eye.rotation).wxyz
        place = self._placing.place(eye.centre)
        if eye.name in self._frusta:
            self._frusta[eye.name].position, self._frusta[eye.name].wxyz = place, turned
            return
        self._frusta[eye.name] = self._scene.add_camera_frustum(
            f"/cameras/{eye.name}", eye.fov, eye.aspect, scale=0.22, thickness=2.0, thickness_units="screen",
            color=(190, 200, 215), position=place, wxyz=turned, cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._scene.add_label(f"/cameras/{eye.name}/name", eye.name, position=(0.0, -0.12, 0.0), font_screen_scale=0.8)

    def _pictures(self, state: State) -> None:
        cv2 = opencv()
        for look in state.looks:
            frustum = self._frusta.get(look.camera)
            if frustum is None or look.frame is None:
                continue
            height, width = look.frame.picture.shape
            small = cv2.resize(
                eight_bit(look.frame.picture), (THUMB, max(1, THUMB * height // width)), interpolation=cv2.INTER_AREA
            )
            frustum.image = np.repeat(small[..., None], 3, axis=2)

    def _points(self, name: str, xyz: Floats, colour: tuple[int, int, int], shape: Any) -> None:
        if len(xyz):
            self._scene.add_point_cloud(
                f"/{name}", self._placing.place(xyz), colour, point_size=0.055, point_shape=shape
            )
        else:
            self._scene.remove_by_name(f"/{name}")

    def _cloud(self, state: State) -> None:
        if state.predicted is None:
            self._scene.remove_by_name("/uncertainty")
            return
        u95 = state.predicted.u95
        if self.scale is None and np.isfinite(u95).any():
            stop = line(self._loop.rule)
            self.scale = Scale.around(stop.value / 3 if stop is not None else 0.5 * float(np.nanmedian(u95)))
        if self.scale is None:
            return
        colours = EXCESS_SCALE.colours(state.predicted.excess) if self.shown == EXCESS else self.scale.colours(u95)
        self._scene.add_point_cloud(
            "/uncertainty", self._placing.place(self._loop.judged_at), colours, point_size=0.028, point_shape="circle",
            point_shading="flat",
        )  # fmt: skip

    def _target(self, state: State) -> None:
        """A bright ball in a halo, and its shadow lines to the walls: depth is hard to see else."""
        if state.target is None:
            self._scene.remove_by_name("/target")
            return
        self._scene.add_frame("/target", show_axes=False, position=self._placing.place(state.target.xyz))
        self._scene.add_icosphere("/target/ball", 0.05, color=TARGET, cast_shadow=False)
        self._scene.add_icosphere("/target/halo", 0.11, color=TARGET, opacity=0.3, cast_shadow=False)
        self._scene.add_label("/target/name", "target", position=(0.0, 0.0, 0.16), font_screen_scale=0.9)

    def _ball(self, here: Floats) -> None:
        if not np.isfinite(here).all():
            self._scene.remove_by_name("/ball")
            return
        self._scene.add_icosphere("/ball", 0.04, color=BALL, position=self._placing.place(here), cast_shadow=False)
