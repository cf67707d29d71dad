"""All drawing of the planar task: scenes as RGB arrays without a display, and a window that shows them.

Scenes are drawn at twice their size and scaled down, which smooths every edge alike.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rise_envs.vehicle_world import Array, Params

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # importing an environment must not print
import pygame

SIZE, STRIP = 640, 32  # px: the square view and the line of text below it; multiples of 16 suit video codecs
SMOOTH = 2
MARGIN = 1.0  # m around the arena
ARROW_TIME = 2.0  # s: arrows show where a disc would go in this time
VEHICLE_ARROW_TIME = 1.0  # s: and the vehicle, which is faster, in this one

Colour = tuple[int, int, int]
Pixel = tuple[float, float]
OUTSIDE, FLOOR, GRID, BORDER = (233, 236, 241), (253, 253, 254), (240, 242, 245), (160, 168, 180)
INK, PALE_INK = (38, 43, 54), (110, 118, 132)
VEHICLE, VEHICLE_RIM, TRAIL_OLD = (37, 99, 235), (24, 62, 150), (205, 219, 250)
GOAL, GOAL_FILL = (21, 145, 68), (206, 240, 216)
OBSTACLE, OBSTACLE_RIM = (229, 72, 77), (150, 24, 32)
READING = (64, 34, 120)
WARNING = (205, 32, 44)
MOTION = (240, 150, 10)  # of the robot's arrow: the paper's key frames have such


class Canvas:
    """A square view of the plane, ``half`` metres to each side of the origin, on ``surface``."""

    def __init__(self, surface: pygame.Surface, half: float) -> None:
        self.surface = surface
        self.half, self.scale = half, SIZE * SMOOTH / (2 * half)

    def at(self, point: Array) -> Pixel:
        """Pixel of a point (2,) in m; y points upwards in the world."""
        return (float(point[0] + self.half) * self.scale, float(self.half - point[1]) * self.scale)

    def point(self, x: float, y: float) -> Array:
        """Where in the world (m) the pixel (x, y) is."""
        return np.array([x / self.scale - self.half, self.half - y / self.scale])

    def disc(self, center: Array, radius: float, fill: Colour, rim: Colour | None = None) -> None:
        """A filled disc (m) with a rim drawn inside its edge, so that its size stays true."""
        pixels = radius * self.scale
        pygame.draw.circle(self.surface, rim or fill, self.at(center), pixels)
        pygame.draw.circle(self.surface, fill, self.at(center), max(pixels - 2 * SMOOTH, 0))

    def ring(self, center: Array, radius: float, colour: Colour, width: float = 2.0) -> None:
        """A circle (m) with a line of ``width`` px."""
        pygame.draw.circle(self.surface, colour, self.at(center), radius * self.scale, round(width * SMOOTH))

    def line(self, start: Array, end: Array, colour: Colour, width: float = 2.0) -> None:
        """A line (m) of ``width`` px with square ends."""
        a, b = np.array(self.at(start)), np.array(self.at(end))
        side = np.array([a[1] - b[1], b[0] - a[0]])
        side *= 0.5 * width * SMOOTH / max(float(np.hypot(*side)), 1e-9)
        pygame.draw.polygon(self.surface, colour, [a + side, b + side, b - side, a - side])

    def dashed_ring(self, center: Array, radius: float, colour: Colour, width: float = 2.5) -> None:
        """A dashed circle (m)."""
        n = max(6, round(radius * self.scale * np.pi / (8 * SMOOTH)))
        reach = 0.5 * width * SMOOTH / self.scale * np.array([1.0, -1.0])
        for start in np.arange(n) * (2 * np.pi / n):
            angle = start + np.arange(5) * (0.29 * np.pi / n)
            arc = np.stack((np.cos(angle), np.sin(angle)), -1)
            rim = np.concatenate((arc * (radius + reach[0]), arc[::-1] * (radius + reach[1])))
            pygame.draw.polygon(self.surface, colour, [self.at(center + p) for p in rim])

    def arrow(
        self, start: Array, vector: Array, colour: Colour, width: float = 3.0, dashed: bool = False
    ) -> None:
        """An arrow (m) from ``start`` along ``vector``; none if it is too short to have a direction."""
        length, head = float(np.hypot(*vector)), (5 + 2 * width) * SMOOTH / self.scale
        if length < 0.15:
            return
        ahead = vector / length
        side, tip = np.array([-ahead[1], ahead[0]]), start + vector
        head = min(head, 0.8 * length)
        neck = tip - head * ahead
        dash = 6 * SMOOTH / self.scale if dashed else length
        for begin in np.arange(0.0, length - head, 1.8 * dash):
            stop = min(begin + dash, length - head)
            self.line(start + begin * ahead, start + stop * ahead, colour, width)
        corners = (tip, neck + 0.5 * head * side, neck - 0.5 * head * side)
        pygame.draw.polygon(self.surface, colour, [self.at(p) for p in corners])

    def array(self) -> NDArray[np.uint8]:
        """The picture (H, W, 3)."""
        width, height = self.surface.get_size()
        small = pygame.transform.smoothscale(self.surface, (width // SMOOTH, height // SMOOTH))
        return np.ascontiguousarray(pygame.surfarray.pixels3d(small).swapaxes(0, 1))


def draw_vehicle_scene(
    state: Array,
    goal: Array,
    n_obstacles: int,
    reading: Array,
    perceived: Array | None,
    trail: Sequence[Array],
    params: Params,
) -> NDArray[np.uint8]:
    """The vehicle's scene: arena, start, trail, goal, true discs (solid), discs as read (dashed), vehicle.

    Arrows show how discs move, and how the vehicle has moved in the last step.

    The view holds the whole arena, and widens when the vehicle has left it.

    Args:
        state: (x, y, θ), m and rad, (3,).
        goal: (2,), m.
        n_obstacles: how many balls: N.
        reading: the true readings, (5N,).
        perceived: the readings as the agent got them, (5N,), or ``None``.
        trail: the positions (2,) since the start, one per step.
        params: sizes and step time.

    Returns:
        The picture, (672, 640, 3) uint8.
    """
    half = params.obstacle_half + MARGIN
    half = max(half, float(np.abs(trail).max(initial=0.0)) + params.robot_radius + MARGIN)
    canvas = Canvas(_floor(half, params.obstacle_half).copy(), half)
    _draw_goal(canvas, goal, params.goal_radius)
    _draw_trail(canvas, trail)
    discs = reading.reshape(n_obstacles, 5)
    for disc in discs:
        canvas.disc(disc[:2], disc[4], OBSTACLE, OBSTACLE_RIM)
        canvas.arrow(disc[:2], ARROW_TIME * disc[2:4], OBSTACLE_RIM)
    clearance = np.linalg.norm(discs[:, :2] - state[:2], axis=-1) - discs[:, 4] - params.robot_radius
    _draw_vehicle(canvas, state, params.robot_radius, bool(clearance.min() < 0))
    if len(trail) > 1:
        _draw_motion(canvas, trail[-1], (trail[-1] - trail[-2]) / params.dt, params.robot_radius)
    for disc in () if perceived is None else perceived.reshape(n_obstacles, 5):
        _draw_as_read(canvas, disc)
    _draw_strip(canvas, (len(trail) - 1) * params.dt, float(clearance.min()), perceived is not None)
    return canvas.array()


@lru_cache(maxsize=4)
def _floor(half: float, arena: float) -> pygame.Surface:
    """The empty arena, ``arena`` metres to each side, with a grid of 1 m."""
    canvas = Canvas(pygame.Surface((SIZE * SMOOTH, (SIZE + STRIP) * SMOOTH), 0, 32), half)
    canvas.surface.fill(OUTSIDE)
    (left, top), (right, bottom) = canvas.at(np.array([-arena, arena])), canvas.at(np.array([arena, -arena]))
    area = pygame.Rect(round(left), round(top), round(right - left), round(bottom - top))
    pygame.draw.rect(canvas.surface, FLOOR, area)
    for metre in np.arange(np.ceil(-arena), arena + 1e-9):
        for a, b in (([metre, -arena], [metre, arena]), ([-arena, metre], [arena, metre])):
            canvas.line(np.array(a), np.array(b), GRID if metre % 5 else OUTSIDE, 1.0 if metre % 5 else 1.5)
    pygame.draw.rect(canvas.surface, BORDER, area, round(1.5 * SMOOTH))
    return canvas.surface


def _draw_goal(canvas: Canvas, goal: Array, radius: float) -> None:
    """The goal region with a flag in its middle."""
    canvas.disc(goal, radius, GOAL_FILL, GOAL)
    pole = goal + np.array([[-0.12, -0.3], [-0.12, 0.42]])
    flag = goal + np.array([[-0.12, 0.42], [0.33, 0.25], [-0.12, 0.08]])
    canvas.line(pole[0], pole[1], GOAL, 2.0)
    pygame.draw.polygon(canvas.surface, GOAL, [canvas.at(p) for p in flag])


def _draw_trail(canvas: Canvas, trail: Sequence[Array]) -> None:
    """Where the vehicle was, paler the longer ago, and a ring where it started."""
    points = [canvas.at(p) for p in trail]
    for i, (a, b) in enumerate(pairwise(points)):
        share = (i + 1) / len(points)
        colour = tuple(round(o + share * (n - o)) for o, n in zip(TRAIL_OLD, VEHICLE, strict=True))
        pygame.draw.line(canvas.surface, colour, a, b, 3 * SMOOTH)
        pygame.draw.circle(canvas.surface, colour, b, 1.5 * SMOOTH)
    canvas.disc(trail[0], 0.28, FLOOR, PALE_INK)


def _draw_vehicle(canvas: Canvas, state: Array, radius: float, collides: bool) -> None:
    """The vehicle's disc with a wedge that points along its heading; ringed in a collision."""
    position, heading = state[:2], float(state[2])
    canvas.disc(position, radius, VEHICLE, VEHICLE_RIM)
    angles = heading + np.array([0.0, 2.45, np.pi, -2.45])
    reach = radius * np.array([0.82, 0.72, 0.28, 0.72])
    wedge = position + reach[:, None] * np.stack((np.cos(angles), np.sin(angles)), -1)
    pygame.draw.polygon(canvas.surface, FLOOR, [canvas.at(p) for p in wedge])
    if collides:
        canvas.ring(position, radius + 6 * SMOOTH / canvas.scale, WARNING, 3.0)


def _draw_motion(canvas: Canvas, position: Array, velocity: Array, radius: float) -> None:
    """Where the vehicle would go, from its rim on: the wedge stays visible."""
    way = VEHICLE_ARROW_TIME * velocity
    length = float(np.hypot(*way))
    if length > radius:
        rim = radius / length * way
        canvas.arrow(position + rim, way - rim, MOTION, 3.5)


def _draw_as_read(canvas: Canvas, disc: Array) -> None:
    """A disc as the agent read it, cased in white; a mere cross where noise left no radius to draw."""
    center, radius = disc[:2], float(disc[4])
    for colour, casing in ((FLOOR, 2.5), (READING, 0.0)):
        if radius > 0.1:
            canvas.dashed_ring(center, radius, colour, 2.5 + casing)
        for corner in (np.array([0.14, 0.14]), np.array([0.14, -0.14])):
            canvas.line(center - corner, center + corner, colour, 2.0 + casing)
        canvas.arrow(center, ARROW_TIME * disc[2:4], colour, 2.5 + casing, dashed=True)


@lru_cache(maxsize=1)
def _font() -> pygame.font.Font:
    pygame.font.init()
    return pygame.font.Font(None, 20 * SMOOTH)


def lettering(text: str, colour: Colour) -> pygame.Surface:
    """A line of text, at twice its size."""
    try:
        return _font().render(text, True, colour)
    except pygame.error:  # somebody else, another environment say, has called pygame.quit() since
        _font.cache_clear()
        return _font().render(text, True, colour)


def _write(canvas: Canvas, text: str, x: float, colour: Colour) -> float:
    """Write into the strip from ``x`` (px); returns where the text ends."""
    line = lettering(text, colour)
    canvas.surface.blit(line, (x, SMOOTH * (SIZE + STRIP / 2) - line.get_height() / 2))
    return x + line.get_width()


def _draw_strip(canvas: Canvas, time: float, clearance: float, as_read: bool) -> None:
    """Time and clearance to the left, the legend to the right."""
    s = SMOOTH
    pygame.draw.rect(canvas.surface, FLOOR, (0, SIZE * s, SIZE * s, STRIP * s))
    pygame.draw.line(canvas.surface, BORDER, (0, SIZE * s), (SIZE * s, SIZE * s), s)
    _write(canvas, f"{time:.1f} s", 14 * s, INK)
    text = f"clearance {clearance:.2f} m" if clearance >= 0 else f"collision {clearance:.2f} m"
    _write(canvas, text, 74 * s, INK if clearance >= 0 else WARNING)
    legend = [(216, "start"), (284, "goal"), (348, "obstacle, true")]
    for x, name in [*legend, (477, "obstacle, as read")] if as_read else legend:
        _draw_symbol(canvas, canvas.point(x * s, (SIZE + STRIP / 2) * s), name)
        _write(canvas, name, (x + 14) * s, PALE_INK)


def _draw_symbol(canvas: Canvas, at: Array, name: str) -> None:
    """The legend's picture of one thing."""
    radius = 7 * SMOOTH / canvas.scale
    if name == "start":
        canvas.disc(at, 0.75 * radius, FLOOR, PALE_INK)
    elif name == "goal":
        canvas.disc(at, radius, GOAL_FILL, GOAL)
    elif name == "obstacle, true":
        canvas.disc(at, radius, OBSTACLE, OBSTACLE_RIM)
    else:
        canvas.dashed_ring(at, radius, READING, 2.0)


def _screen(size: tuple[int, int]) -> pygame.Surface:
    """A window of the size (W, H), px."""
    try:
        pygame.display.init()
        screen = pygame.display.set_mode(size)
        # What SDL falls back to, so that nobody sees anything.
        if pygame.display.get_driver() == "offscreen" != os.environ.get("SDL_VIDEODRIVER"):
            raise pygame.error("no display; DISPLAY or WAYLAND_DISPLAY name one")
    except pygame.error as error:
        pygame.display.quit()
        raise pygame.error(f"no window can be opened here: {error}") from None
    return screen


class Window:
    """A window on the screen that shows pictures at a steady rate.

    Args:
        shape: (H, W, 3) of the pictures.
        fps: pictures per second.
        title: of the window.

    Raises:
        pygame.error: there is no display.
    """

    def __init__(self, shape: tuple[int, ...], fps: float, title: str = "RISE") -> None:
        self._screen: pygame.Surface | None = _screen((shape[1], shape[0]))
        pygame.display.set_caption(title)
        self._clock, self._fps = pygame.time.Clock(), fps

    @property
    def is_open(self) -> bool:
        """Whether it was neither closed by the program nor by its user."""
        return self._screen is not None

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture (H, W, 3); once the user has closed the window, do nothing."""
        if self._screen is None:
            return
        # Keys are left in the queue: a program that lets people drive reads them.
        for event in pygame.event.get(exclude=(pygame.KEYDOWN, pygame.KEYUP)):
            if event.type == pygame.QUIT:
                self.close()
                return
        pygame.surfarray.blit_array(self._screen, picture.swapaxes(0, 1))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def name(self, title: str) -> None:
        """Change the title."""
        if self._screen is not None:
            pygame.display.set_caption(title)

    def close(self) -> None:
        """Close the window. May be called twice."""
        if self._screen is not None:
            self._screen = None
            pygame.display.quit()
