"""All drawing of the arm's task but the arm: spheres, trail and shadows laid over the engine's own picture.

The engine draws arm and table, and says how deep each pixel lies. What moves freely is ray-cast into that
picture here, so that it hides and is hidden rightly, has smooth edges and true translucency (the engine's
renderer has neither), and needs no bodies in the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pygame
from numpy.typing import NDArray

from rise_envs.rendering import (
    ARROW_TIME,
    BORDER,
    FLOOR,
    GOAL,
    GOAL_FILL,
    INK,
    MOTION,
    OBSTACLE,
    OBSTACLE_RIM,
    PALE_INK,
    READING,
    SIZE,
    SMOOTH,
    STRIP,
    TRAIL_OLD,
    VEHICLE,
    WARNING,
    Canvas,
    Colour,
    lettering,
)

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

WIDTH, HEIGHT = 720, 480  # px, the strip of text included
VIEW = HEIGHT - STRIP
EYE, TARGET = np.array([0.97, -0.82, 0.90]), np.array([-0.16, -0.02, 0.28])  # m
FIELD = np.radians(38.0)  # vertical angle of view
NEAR, FAR = 0.1, 6.0  # m
LIGHT = np.array([0.45, -0.45, 0.77])
HAND_ARROW_TIME = (
    0.2  # s: the hand's arrow shows where it would go in this time; it is much faster than the sphere
)
SKY = np.array([[236, 239, 244], [250, 251, 253]])  # the backdrop's colours, top and bottom


class Camera:
    """Where the scene is seen from; every picture is taken from the same place."""

    def __init__(self) -> None:
        ahead = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self.axes = np.array([right, np.cross(right, ahead), -ahead])  # OpenGL's: x right, y up, z backwards
        self.focal = VIEW / 2 / np.tan(FIELD / 2)  # px
        self.view = np.eye(4)
        self.view[:3, :3], self.view[:3, 3] = self.axes, -self.axes @ EYE
        scale = 2 * self.focal
        self.projection = np.diag([scale / WIDTH, scale / VIEW, -(FAR + NEAR) / (FAR - NEAR), 0.0])
        self.projection[2, 3], self.projection[3, 2] = -2 * FAR * NEAR / (FAR - NEAR), -1.0

        y, x = np.mgrid[:VIEW, :WIDTH] + 0.5
        self.rays = np.stack((x - WIDTH / 2, VIEW / 2 - y, np.full_like(x, -self.focal)), -1) @ self.axes
        self.rays /= self.focal  # (VIEW, WIDTH, 3), one metre deep
        self.table = EYE[:2] - EYE[2] * self.rays[..., :2] / self.rays[..., 2:]  # where a ray meets z = 0
        self.table_depth = -EYE[2] / self.rays[..., 2]
        fade = np.linspace(0.0, 1.0, VIEW)[:, None, None]
        self.sky = np.broadcast_to((1 - fade) * SKY[0] + fade * SKY[1], self.rays.shape).astype(np.float32)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (..., 2) and depths (...) in m of points (..., 3)."""
        local = (points - EYE) @ self.axes.T
        depth = -local[..., 2]
        pixel = self.focal * local[..., :2] * [1, -1] / depth[..., None] + [WIDTH / 2, VIEW / 2]
        return pixel, depth

    @staticmethod
    def metres(buffer: NDArray) -> NDArray[np.float32]:
        """Depth in m from the engine's depth buffer."""
        return FAR * NEAR / (FAR - (FAR - NEAR) * buffer.astype(np.float32))


@lru_cache(maxsize=1)
def camera() -> Camera:
    """The camera of all pictures."""
    return Camera()


@dataclass
class Picture:
    """A picture in the making: colours (VIEW, WIDTH, 3), as floats, and depth (VIEW, WIDTH) in m."""

    colour: NDArray[np.float32]
    depth: NDArray[np.float32]

    @staticmethod
    def _window(pixel: Array, reach: float) -> tuple[slice, slice]:
        """The part of the picture within ``reach`` px of a pixel."""
        size = np.array([WIDTH, VIEW])
        low = np.clip(np.floor(pixel - reach), 0, size).astype(int)
        high = np.clip(np.ceil(pixel + reach) + 1, 0, size).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _blend(self, window: tuple[slice, slice], colour: NDArray, alpha: Array) -> None:
        part = self.colour[window]
        part += alpha[..., None] * (colour - part)

    def ball(self, center: Array, radius: float, colour: Colour, alpha: float = 1.0) -> None:
        """A shaded sphere (m); a translucent one hides nothing that comes later."""
        eye = camera()
        pixel, depth = eye.project(center)
        if depth < radius + NEAR:
            return  # too near the camera, or behind it
        window = self._window(pixel, 1.2 * radius * eye.focal / depth + 2)
        rays = eye.rays[window]
        length = np.linalg.norm(rays, axis=-1)
        rays = rays / length[..., None]
        offset = center - EYE
        along = rays @ offset
        miss = np.linalg.norm(offset - along[..., None] * rays, axis=-1)
        half = np.sqrt(np.maximum(radius**2 - miss**2, 0.0))
        normal = ((along - half)[..., None] * rays - offset) / radius
        light = 0.62 + 0.38 * np.clip(normal @ LIGHT, 0.0, 1.0)
        front = (along - half) / length
        edge = np.clip((radius - miss) * eye.focal / depth + 0.5, 0.0, 1.0)
        seen = edge * (front < self.depth[window])
        self._blend(window, np.array(colour) * light[..., None], alpha * seen)
        if alpha == 1.0:
            self.depth[window] = np.where(seen > 0.5, front, self.depth[window])

    def rim(self, center: Array, radius: float, colour: Colour, width: float, dashes: int = 0) -> None:
        """The outline of a sphere (m), ``width`` px wide, before everything; dashed if ``dashes``."""
        eye = camera()
        pixel, depth = eye.project(center)
        if depth < radius + NEAR:
            return  # too near the camera, or behind it
        reach = radius * eye.focal / depth
        window = self._window(pixel, 1.2 * reach + width + 2)
        y, x = np.mgrid[window] + 0.5
        rays = eye.rays[window] / np.linalg.norm(eye.rays[window], axis=-1, keepdims=True)
        offset = center - EYE
        miss = np.linalg.norm(offset - (rays @ offset)[..., None] * rays, axis=-1) * eye.focal / depth
        alpha = np.clip((width + 1) / 2 - np.abs(miss - reach), 0.0, 1.0)
        if dashes:
            turn = np.arctan2(y - pixel[1], x - pixel[0]) / (2 * np.pi) * dashes % 1.0
            alpha = alpha * np.clip((0.3 - np.abs(turn - 0.5)) * 2 * np.pi * reach / dashes + 0.5, 0.0, 1.0)
        self._blend(window, np.array(colour), alpha)

    def line(self, a: Array, b: Array, colour: Colour, width: float, on_top: bool = False) -> None:
        """A line (m) of ``width`` px with round ends, hidden by what lies before it unless ``on_top``."""
        (start, end), depths = camera().project(np.array([a, b]))
        if depths.min() < NEAR:
            return
        window = self._window((start + end) / 2, float(np.abs(end - start).max()) / 2 + width + 2)
        y, x = np.mgrid[window] + 0.5
        way = end - start
        share = ((x - start[0]) * way[0] + (y - start[1]) * way[1]) / max(float(way @ way), 1e-9)
        share = np.clip(share, 0.0, 1.0)
        miss = np.hypot(x - start[0] - share * way[0], y - start[1] - share * way[1])
        cover = np.clip((width + 1) / 2 - miss, 0.0, 1.0)
        if not on_top:
            cover = cover * (1 / (share / depths[1] + (1 - share) / depths[0]) < self.depth[window] + 0.002)
        self._blend(window, np.array(colour), cover)

    def arrow(self, start: Array, vector: Array, colour: Colour, width: float = 2.5) -> None:
        """An arrow (m) on top of everything; none if it is too short to have a direction."""
        if np.linalg.norm(vector) < 0.02:
            return
        tip = start + vector
        ahead = vector / np.linalg.norm(vector)
        side = np.cross(ahead, TARGET - EYE)
        side /= max(float(np.linalg.norm(side)), 1e-9)
        self.line(start, tip, colour, width, on_top=True)
        for turn in (1, -1):
            self.line(tip, tip - 0.025 * ahead + turn * 0.015 * side, colour, width, on_top=True)

    def shadow(self, center: Array, radius: float, strength: float) -> None:
        """Darken the table under a sphere, as light from straight above would leave it."""
        eye = camera()
        pixel, depth = eye.project(np.array([center[0], center[1], 0.0]))
        window = self._window(pixel, 1.2 * (radius + 0.02) * eye.focal / depth)
        away = np.linalg.norm(eye.table[window] - center[:2], axis=-1)
        soft = np.clip((radius - away) / 0.02 + 0.5, 0.0, 1.0)
        soft *= np.abs(self.depth[window] - eye.table_depth[window]) < 0.01
        self._blend(window, np.zeros(3), strength * soft)


def draw_panda_scene(
    shot: tuple[Image, NDArray, NDArray[np.bool_]],
    goal: Array,
    goal_radius: float,
    reading: Array,
    perceived: Array | None,
    trail: Sequence[Array],
    clearance: float,
    dt: float,
) -> Image:
    """The arm's scene: arm and table, trail of the hand, goal, true sphere (solid), sphere as read (translucent).

    Arrows show how the sphere moves, and how the hand has moved in the last step.

    Args:
        shot: the engine's picture (VIEW, WIDTH, 3) of arm and table, its depth buffer (VIEW, WIDTH), and where
            it shows either of them (VIEW, WIDTH).
        goal: goal point (m), (3,).
        goal_radius: distance from it that counts as reached (m).
        reading: the true reading, (7,).
        perceived: the reading as the agent got it, (7,), or ``None``.
        trail: positions of the hand since the start (m), (3,) each, one per step.
        clearance: least signed distance of arm and sphere in the last step (m).
        dt: time between the positions (s).

    Returns:
        The picture, (HEIGHT, WIDTH, 3) uint8.
    """
    picture = _backdrop(*shot)
    center, velocity, radius = reading[:3], reading[3:6], float(reading[6])
    picture.shadow(center, radius, 0.22)
    picture.shadow(goal, goal_radius, 0.12)
    picture.shadow(trail[-1], 0.02, 0.15)
    _draw_trail(picture, trail)
    picture.ball(goal, 0.4 * goal_radius, GOAL)
    picture.ball(center, radius, OBSTACLE)
    picture.ball(goal, goal_radius, GOAL, alpha=0.25)
    picture.rim(goal, goal_radius, GOAL, 1.5)
    picture.arrow(center, ARROW_TIME * velocity, OBSTACLE_RIM)
    if len(trail) > 1:
        picture.arrow(trail[-1], HAND_ARROW_TIME / dt * (trail[-1] - trail[-2]), MOTION, 3.0)
    if clearance < 0:
        picture.rim(center, radius + 0.006, WARNING, 3.0)
    if perceived is not None:
        _draw_as_read(picture, perceived)
    scene = np.clip(picture.colour + 0.5, 0, 255).astype(np.uint8)
    return np.concatenate((scene, _strip((len(trail) - 1) * dt, clearance, perceived is not None)))


def _backdrop(image: Image, buffer: NDArray, shown: NDArray[np.bool_]) -> Picture:
    """The engine's picture with smoothed edges before a plain backdrop."""
    colour = np.where(shown[..., None], image, camera().sky)
    depth = np.where(shown, Camera.metres(buffer), np.float32(np.inf))
    # Along edges the mean of the neighbourhood takes the stairs away.
    level = np.where(shown, 40 * depth, np.float32(1e3)) + colour.sum(-1) / 20
    edge = np.zeros(level.shape, bool)
    down, across = np.abs(np.diff(level, axis=0)) > 3, np.abs(np.diff(level, axis=1)) > 3
    edge[1:], edge[:-1] = down, edge[:-1] | down
    edge[:, 1:], edge[:, :-1] = edge[:, 1:] | across, edge[:, :-1] | across
    y, x = np.nonzero(edge)
    above, below = np.maximum(y - 1, 0), np.minimum(y + 1, VIEW - 1)
    left, right = np.maximum(x - 1, 0), np.minimum(x + 1, WIDTH - 1)
    around = colour[above, x] + colour[below, x] + colour[y, left] + colour[y, right]
    colour[y, x] = (colour[y, x] + around) / 5
    return Picture(colour, depth)


def _draw_trail(picture: Picture, trail: Sequence[Array]) -> None:
    """Where the hand was, paler the longer ago."""
    old, new = np.array(TRAIL_OLD), np.array(VEHICLE)
    for i, (a, b) in enumerate(pairwise(trail)):
        colour = tuple(old + (i + 1) / (len(trail) - 1) * (new - old))
        picture.line(a, b, colour, 3.0)


def _draw_as_read(picture: Picture, perceived: Array) -> None:
    """The sphere as the agent read it; a mere cross where noise left no radius to draw."""
    center, radius = perceived[:3], float(perceived[6])
    if radius > 0.01:
        picture.ball(center, radius, READING, alpha=0.35)
        picture.rim(center, radius, READING, 2.5, dashes=max(8, round(160 * radius)))
    for axis in np.eye(3) * 0.012:
        picture.line(center - axis, center + axis, READING, 2.0, on_top=True)
    picture.arrow(center, ARROW_TIME * perceived[3:6], READING)


def _strip(time: float, clearance: float, as_read: bool) -> Image:
    """Time and clearance to the left, the legend to the right, (STRIP, WIDTH, 3)."""
    s = SMOOTH
    surface = pygame.Surface((WIDTH * s, STRIP * s), 0, 32)
    canvas = Canvas(surface, SIZE * s / 2)  # one unit is one pixel
    surface.fill(FLOOR)
    pygame.draw.line(surface, BORDER, (0, 0), (WIDTH * s, 0), s)

    def write(text: str, x: float, colour: Colour) -> None:
        line = lettering(text, colour)
        surface.blit(line, (x * s, (STRIP * s - line.get_height()) / 2))

    write(f"{time:.2f} s", 14, INK)
    text = f"clearance {clearance:.2f} m" if clearance >= 0 else f"collision {clearance:.2f} m"
    write(text, 80, INK if clearance >= 0 else WARNING)
    middle = STRIP * s / 2
    pygame.draw.line(surface, VEHICLE, (256 * s, middle), (272 * s, middle), 3 * s)
    write("hand", 278, PALE_INK)
    canvas.disc(canvas.point(340 * s, middle), 7 * s, GOAL_FILL, GOAL)
    write("goal", 354, PALE_INK)
    canvas.disc(canvas.point(414 * s, middle), 7 * s, OBSTACLE, OBSTACLE_RIM)
    write("obstacle, true", 428, PALE_INK)
    if as_read:
        canvas.dashed_ring(canvas.point(560 * s, middle), 7 * s, READING, 2.0)
        write("obstacle, as read", 574, PALE_INK)
    return canvas.array()
