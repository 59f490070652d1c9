"""A small pygame canvas in world units."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import DependencyNotInstalled

Color = tuple[int, int, int]
Point = tuple[float, float]

SKY: Color = (245, 247, 250)
GROUND: Color = (214, 221, 229)
INK: Color = (52, 64, 79)
STEEL: Color = (128, 140, 155)
BLUE: Color = (43, 108, 176)
ORANGE: Color = (226, 125, 38)
GREEN: Color = (56, 142, 96)

#: Shapes are drawn this many times larger and scaled down, which smooths the edges of all of them.
OVERSAMPLING = 2


def turned(points: Sequence[Point], angle: float, at: Point = (0.0, 0.0)) -> list[Point]:
    """
    :param points: corners of a shape around the origin
    :param angle: counter-clockwise, radians
    :param at: new position of the origin
    :return: the shape rotated around the origin, then translated
    """
    cos, sin = math.cos(angle), math.sin(angle)
    return [(at[0] + cos * x - sin * y, at[1] + sin * x + cos * y) for x, y in points]


class Canvas:
    """
    Draws shapes given in world units, x to the right and y upwards, into a window or an array.

    :param size: width and height of the image, pixels
    :param center: world coordinates of the image centre
    :param scale: pixels per world unit
    :param human: whether to open a window
    :param fps: maximum frame rate of the window
    :param caption: title of the window
    :raises DependencyNotInstalled: if pygame is missing
    """

    def __init__(
        self, size: tuple[int, int], center: Point, scale: float, *, human: bool, fps: int, caption: str
    ) -> None:
        try:
            import pygame
        except ImportError as error:
            raise DependencyNotInstalled(
                'rendering needs pygame; install it with `pip install "gymnasium[classic-control]"`'
            ) from error
        self._pygame = pygame
        self.size, self.center, self.scale = size, center, scale * OVERSAMPLING
        self.fps = fps
        self._large = pygame.Surface((size[0] * OVERSAMPLING, size[1] * OVERSAMPLING), depth=32)
        self._small = pygame.Surface(size, depth=32)
        self._window: pygame.Surface | None = None
        self._clock: pygame.time.Clock | None = None
        # Only a window needs a display: arrays can be rendered on machines without one.
        if human:
            pygame.display.init()
            self._window = pygame.display.set_mode(size)
            pygame.display.set_caption(caption)
            self._clock = pygame.time.Clock()

    def _pixels(self, points: Sequence[Point]) -> list[Point]:
        middle_x, middle_y = 0.5 * self._large.get_width(), 0.5 * self._large.get_height()
        return [
            (middle_x + (x - self.center[0]) * self.scale, middle_y - (y - self.center[1]) * self.scale)
            for x, y in points
        ]

    def fill(self, color: Color) -> None:
        """:param color: colour of the whole image"""
        self._large.fill(color)

    def polygon(self, points: Sequence[Point], color: Color) -> None:
        """
        :param points: corners, world units
        :param color: fill colour
        """
        self._pygame.draw.polygon(self._large, color, self._pixels(points))

    def circle(self, center: Point, radius: float, color: Color) -> None:
        """
        :param center: world units
        :param radius: world units
        :param color: fill colour
        """
        self._pygame.draw.circle(self._large, color, self._pixels([center])[0], radius * self.scale)

    def bar(self, start: Point, end: Point, width: float, color: Color, *, rounded: bool = True) -> None:
        """
        :param start: world units
        :param end: world units
        :param width: world units
        :param color: fill colour
        :param rounded: whether the ends are round
        """
        length = math.dist(start, end)
        if length > 0.0:
            angle = math.atan2(end[1] - start[1], end[0] - start[0])
            half = 0.5 * width
            self.polygon(turned([(0, -half), (length, -half), (length, half), (0, half)], angle, start), color)
        if rounded:
            self.circle(start, 0.5 * width, color)
            self.circle(end, 0.5 * width, color)

    def path(self, points: Sequence[Point], width: float, color: Color) -> None:
        """
        :param points: world units
        :param width: world units
        :param color: line colour
        """
        for start, end in itertools.pairwise(points):
            self.bar(start, end, width, color)

    def arrow(self, start: Point, end: Point, width: float, color: Color) -> None:
        """
        :param start: world units
        :param end: world units
        :param width: width of the shaft, world units
        :param color: fill colour
        """
        length = math.dist(start, end)
        if length == 0.0:
            return
        angle = math.atan2(end[1] - start[1], end[0] - start[0])
        head = min(3.0 * width, length)
        half, wide = 0.5 * width, 0.5 * head
        self.polygon(
            turned([(0, -half), (length - head, -half), (length - head, half), (0, half)], angle, start), color
        )
        self.polygon(turned([(length - head, -wide), (length, 0), (length - head, wide)], angle, start), color)

    def show(self) -> npt.NDArray[np.uint8] | None:
        """
        :return: the image, shape (height, width, 3), or None if it is shown in the window
        """
        pygame = self._pygame
        pygame.transform.smoothscale(self._large, self.size, self._small)
        if self._window is not None and self._clock is not None:
            self._window.blit(self._small, (0, 0))
            pygame.event.pump()
            self._clock.tick(self.fps)
            pygame.display.flip()
            return None
        pixels: Any = pygame.surfarray.array3d(self._small)
        return np.ascontiguousarray(pixels.transpose(1, 0, 2), dtype=np.uint8)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window = None
            self._pygame.display.quit()
