"""What may be wrong with two frames before any method looks at them: `objectflow check-pair`."""

from objectflow.diagnosis.finding import Finding, Level
from objectflow.diagnosis.pair import examine

__all__ = ["Finding", "Level", "examine"]
