"""The one place that imports rerun, which the extra `view` installs."""

from __future__ import annotations

from objectflow.errors import MissingExtraError

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as error:
    raise MissingExtraError("the viewer needs rerun", "view") from error

__all__ = ["rr", "rrb"]
