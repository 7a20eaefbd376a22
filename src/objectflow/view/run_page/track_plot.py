"""The trajectory of an object as an SVG plot: its position over time, its moving steps and its gaps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from objectflow.tracking.track import Track
from objectflow.view.report_page.assemble import escape
from objectflow.view.run_page.contents import Step, steps

WIDTH, HEIGHT = 560, 220
"""Size of the plot, in its own units, which are pixels at full width."""
LEFT, RIGHT, TOP, BOTTOM = 46, 12, 12, 38
"""Margins around the axes, for tick labels."""
AXES = ("x", "y", "z")
"""Names of the world's axes: right, down and forward of the first camera."""


def track_plot(track: Track, frame_times: Sequence[float], has_times: bool) -> str:
    """Draw the displacement of an object since its first pose, per axis of the world.

    Args:
        track: with at least one pose.
        frame_times: of all frames of its part, ascending; they span the time axis.
        has_times: whether times are seconds; they are then drawn since the first frame.

    Returns:
        An `<svg>` element. Bands mark moving steps, dashed lines mark gaps.
    """
    origin = frame_times[0] if has_times else 0.0
    first, last = frame_times[0] - origin, frame_times[-1] - origin
    span = max(last - first, 1e-9)
    shifts = 100 * np.array([pose[:3, 3] - track.world_T_object[0][:3, 3] for pose in track.world_T_object])
    low, high, ticks = _ticks(float(min(0.0, shifts.min())), float(max(0.0, shifts.max())))

    def x(time: float) -> float:
        return LEFT + (time - origin - first) / span * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM)

    label = f"position of object {track.id} over time, relative to its first position"
    parts = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(label)}">']
    parts += [_step_band(step, x(step.start), x(step.end), origin, has_times) for step in steps(track)]
    for tick in ticks:
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{_number(tick)}</text>')
    parts += [_gap_line(x(time), time - origin, has_times) for time in track.gaps]
    for axis, name in enumerate(AXES):
        values = shifts[:, axis]
        dots = [(x(time), y(float(value))) for time, value in zip(track.times, values, strict=True)]
        points = " ".join(f"{u:.1f},{v:.1f}" for u, v in dots)
        parts.append(f'<polyline class="axis-{name}" points="{points}"/>')
        # The position after the last pose is drawn faintly, since the object may have left the view at rest.
        end = f"{dots[-1][0]:.1f},{dots[-1][1]:.1f} {x(frame_times[-1]):.1f},{dots[-1][1]:.1f}"
        parts.append(f'<polyline class="axis-{name} after" points="{end}"/>')
        parts += [f'<circle class="axis-{name}" cx="{u:.1f}" cy="{v:.1f}" r="2.4"/>' for u, v in dots]
    for time in _time_ticks(first, last):
        u = x(time + origin)
        parts.append(f'<text x="{u:.1f}" y="{HEIGHT - BOTTOM + 15}" text-anchor="middle">{_number(time)}</text>')
    unit = "time since the first frame, s" if has_times else "frame"
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{unit}</text>')
    return "".join([*parts, "</svg>"])


def _step_band(step: Step, left: float, right: float, origin: float, has_times: bool) -> str:
    words = f"{_when(step.start - origin, has_times)} to {_when(step.end - origin, has_times)}"
    words = f"moves: {words}, {100 * step.shift:.1f} cm, score {step.score:.2f}"
    return (
        f'<rect class="step" x="{left:.1f}" y="{TOP}" width="{max(right - left, 1.0):.1f}" '
        f'height="{HEIGHT - TOP - BOTTOM}"><title>{escape(words)}</title></rect>'
    )


def _gap_line(u: float, time: float, has_times: bool) -> str:
    words = f"gap: a motion of low score at {_when(time, has_times)}"
    return (
        f'<line class="gap" x1="{u:.1f}" x2="{u:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}">'
        f"<title>{escape(words)}</title></line>"
    )


def _when(time: float, has_times: bool) -> str:
    return f"{time:.2f} s" if has_times else f"frame {time:.0f}"


def _number(value: float) -> str:
    return f"{value + 0.0:.6g}"


def _ticks(low: float, high: float) -> tuple[float, float, list[float]]:
    """The first, the last and all of three to six round ticks that enclose a range of centimetres."""
    step = _round_step(max(high - low, 1.0) / 4)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    last = max(last, first + 2)
    # 0 is added so that no tick is a negative zero.
    return first * step, last * step, [k * step + 0.0 for k in range(first, last + 1)]


def _time_ticks(first: float, last: float) -> list[float]:
    step = _round_step(max(last - first, 1e-6) / 6)
    start = math.ceil(first / step - 1e-9)
    return [k * step for k in range(start, math.floor(last / step + 1e-9) + 1)]


def _round_step(raw: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is not below `raw`."""
    power = 10.0 ** math.floor(math.log10(raw))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
