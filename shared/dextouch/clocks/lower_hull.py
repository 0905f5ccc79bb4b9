"""Lower convex hull of (device time, apparent offset) points, the basis of clock fits.

A sample cannot arrive before it was sent, so the true offset between two clocks lies on the
lower edge of the cloud of apparent offsets (Moon, Skelly, Towsley 1999; Zhang, Liu, Xia 2002).
The edge of the lower convex hull that spans a given time is the highest line through that time
that stays below every point.
"""

from collections import deque
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

MAX_VERTICES = 256


class Line(NamedTuple):
    """y = y_at_x + slope · (x - x_at); x in seconds, y in nanoseconds."""

    x_at_s: float
    y_at_ns: float
    slope_ns_per_s: float

    def at(self, x_s: float) -> float:
        """Value of the line."""
        return self.y_at_ns + self.slope_ns_per_s * (x_s - self.x_at_s)


class LowerHull:
    """Incremental lower convex hull of points in order of x; old points can be removed.

    Holds at most `MAX_VERTICES` vertices: beyond that every second inner one is dropped.
    """

    def __init__(self) -> None:
        self._vertices: deque[tuple[float, float]] = deque()

    def __iter__(self) -> Iterator[tuple[float, float]]:
        """Vertices in order of x."""
        return iter(self._vertices)

    def moved(self, x_s: float, y_ns: float) -> "LowerHull":
        """A hull of the same points, translated."""
        hull = LowerHull()
        hull._vertices = deque((x + x_s, y + y_ns) for x, y in self._vertices)
        return hull

    @property
    def span_s(self) -> float:
        """Time between the first and the last vertex."""
        return self._vertices[-1][0] - self._vertices[0][0] if self._vertices else 0.0

    def add(self, x_s: float, y_ns: float) -> None:
        """Add a point; its x must not precede the last one's."""
        vertices = self._vertices
        if vertices and vertices[-1][0] == x_s:
            y_ns = min(y_ns, vertices.pop()[1])
        while len(vertices) >= 2:
            (xa, ya), (xb, yb) = vertices[-2], vertices[-1]
            if (yb - ya) * (x_s - xa) < (y_ns - ya) * (xb - xa):
                break
            vertices.pop()
        vertices.append((x_s, y_ns))
        if len(vertices) > MAX_VERTICES:
            last = vertices[-1]
            self._vertices = deque([*list(vertices)[:-1:2], last])

    def forget_before(self, x_s: float) -> None:
        """Drop vertices older than `x_s`, all but the last two."""
        vertices = self._vertices
        while len(vertices) > 2 and vertices[0][0] < x_s:
            vertices.popleft()

    def supporting_line(self, x_s: float) -> Line:
        """The hull's edge that spans `x_s`, or the nearest; horizontal for a single vertex."""
        vertices = self._vertices
        if len(vertices) < 2:
            x, y = vertices[0]
            return Line(x, y, 0.0)
        edges = pairwise(vertices)
        last = (vertices[-2], vertices[-1])
        (xa, ya), (xb, yb) = next((edge for edge in edges if edge[1][0] >= x_s), last)
        return Line(xa, ya, (yb - ya) / (xb - xa))

    def line_of_slope(self, slope_ns_per_s: float) -> Line:
        """The highest line of a given slope that stays below every point."""
        x, y = min(self._vertices, key=lambda vertex: vertex[1] - slope_ns_per_s * vertex[0])
        return Line(x, y, slope_ns_per_s)
