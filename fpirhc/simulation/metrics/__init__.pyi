"""The public names; `__init__.py` imports each when it is first used."""

from . import figures as figures
from .base import RELATIVE_ERROR as RELATIVE_ERROR
from .base import Better as Better
from .base import Metric as Metric
from .base import Metrics as Metrics
from .base import known_metrics as known_metrics
from .base import measure as measure
from .base import with_own_metrics as with_own_metrics
