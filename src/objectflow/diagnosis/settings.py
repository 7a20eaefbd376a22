"""Settings of the checks of a pair."""

from __future__ import annotations

from dataclasses import dataclass

from objectflow.settings import Settings, setting


@dataclass(frozen=True)
class DepthCheckSettings(Settings):
    """Checks of a single frame's depth."""

    min_median_depth: float = setting(0.15, minimum=0)
    """Metres: smallest plausible median depth of a frame over a table or in a room."""
    max_median_depth: float = setting(6.0, above=0)
    """Metres: largest plausible median depth."""
    max_missing_share: float = setting(0.35, minimum=0, maximum=1)
    """Share of pixels without depth above which masks and motions degrade."""
    min_distinct_depths: int = setting(100, minimum=1)
    """Smallest plausible number of distinct depths in a frame; 8-bit or lossy images have fewer."""


@dataclass(frozen=True)
class RegistrationCheckSettings(Settings):
    """The check whether depth is registered to colour; see `registration.Offset`."""

    min_edges: int = setting(150, minimum=1)
    """Minimum number of pixels on depth edges for an estimate."""
    max_shift: float = setting(0.04, above=0, below=0.5)
    """Largest shift of depth that is searched, as a share of the image width."""
    min_gain: float = setting(1.12, minimum=1)
    """Minimum ratio of the colour gradient on the shifted edges to that on the original ones of an accepted shift."""
    min_prominence: float = setting(4.0, minimum=0)
    """Minimum z-score of an accepted shift among all shifts."""


@dataclass(frozen=True)
class QuickCheckSettings(Settings):
    """The screening for unregistered depth before every run; the full check follows only where it finds a shift."""

    width: int = setting(320, minimum=16)
    """Pixels: width at which a shift of depth is searched."""
    min_offset: float = setting(2.0, minimum=0)
    """Pixels at that width: smallest shift that is followed by the full check."""


@dataclass(frozen=True)
class SourceCheckSettings(Settings):
    """The checks of a whole source."""

    samples: int = setting(8, minimum=1)
    """Number of pairs of consecutive frames that are compared for repeated images."""
    min_gap: float = setting(0.3, minimum=0)
    """Seconds: smallest time between the two frames that are examined, if frames have times."""
    large_gap: float = setting(5.0, above=1)
    """Time between two frames that is reported as a gap, in median periods."""


@dataclass(frozen=True)
class DiagnosisSettings(Settings):
    """The checks of a pair and of a source."""

    width: int = setting(640, minimum=16)
    """Pixels: wider frames are downscaled to it; offsets are reported in original pixels."""
    depth: DepthCheckSettings = DepthCheckSettings()
    registration: RegistrationCheckSettings = RegistrationCheckSettings()
    quick: QuickCheckSettings = QuickCheckSettings()
    source: SourceCheckSettings = SourceCheckSettings()
