"""Settings of the second look (`second_look`). Costs and gains are in nats per pixel of the likelihood's size."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class LookWindowSettings(Settings):
    """On which windows the network is evaluated again (`look_windows`)."""

    zoom: float = setting(2.0, above=1)
    """Width of the frame relative to that of a window."""
    enlargement: float = setting(1.5, above=0)
    """Size of things in the network's input relative to that in its first look at the whole frame."""
    max_windows: int = setting(2, minimum=0)
    """Maximum number of windows of a pair; 0 switches the second look off."""
    max_cost: float = setting(3.0, above=0)
    """Cost at which that of a pixel is truncated: a single pixel is no region."""
    smoothing_px: int = setting(9, minimum=1)
    """Pixels: side of the square over which costs are averaged: small motions leave only single pixels unexplained."""
    min_cost: float = setting(0.8, minimum=0)
    """Mean cost of such a square from which it counts as unexplained, where depth and colour have no noise."""
    noise_ratio: float = setting(6.0, minimum=0)
    """What the median of these means, which is the cost of noise, adds to `min_cost`: so many times itself. Where the
    frames fit nowhere, as under a wrong motion of the camera, there is no window."""
    min_share: float = setting(0.0005, above=0, below=1)
    """Share of the image from which an unexplained region has a window."""
    rim_px: int = setting(3, minimum=0)
    """Pixels at the borders of movers that do not count: masks end slightly inside or outside of edges."""
    max_extent: float = setting(0.9, above=0, maximum=1)
    """Largest extent of a region relative to the window: larger things do not become clearer."""


@dataclass(frozen=True)
class SecondLookSettings(Settings):
    """Which objects of the second look are added (`second_look`)."""

    windows: LookWindowSettings = LookWindowSettings()
    max_window_share: float = setting(0.25, above=0, maximum=1)
    """Largest share of its window that an object covers: the whole frame shows larger ones better."""
    min_pixels: int = setting(12, minimum=3)
    """Fewest pixels of an object that have depth."""
    max_overlap: float = setting(0.3, minimum=0, maximum=1)
    """Largest share of its mask that an object may have in common with a more probable one."""
    same_iou: float = setting(0.6, above=0, maximum=1)
    """Intersection over union with a moving object from which an object is known."""
    min_gain: float = setting(0.2, minimum=0)
    """Minimum mean gain of an object's registered motion over what its pixels follow so far."""
    min_total_gain: float = setting(20.0, minimum=0)
    """Minimum sum of this gain over the object's pixels, which noise does not reach on small masks."""
    max_cost: float = setting(1.2, above=0)
    """Largest mean cost of the registered motion."""
    cost_out_of_view: float = setting(3.0, minimum=0)
    """Cost of a point that the previous frame does not show under such a motion."""
    min_noise_ratio: float = setting(2.5, minimum=0)
    """Smallest displacement of an added object relative to the standard deviation of depth there."""
    contradicted_cost: float = setting(2.0, above=0)
    """Mean cost so far from which an object is added even if no registered motion explains it: it cannot have followed
    what its pixels follow, and the steps search for its motion."""
    max_hidden: float = setting(0.5, minimum=0, maximum=1)
    """Largest share of such an object that may have been hidden: what was uncovered need not have moved."""
    then: tuple[str, ...] = ("motion_search", "merge", "reassign", "merge")
    """Steps that follow where an object was added."""
