"""What a user's own member is written with: the contract of every family, blocks and signals, and the steps that members share.

docs/extending.md has an example of each; `fpirhc.conformance` has the laws.
"""

from fpirhc.controllers.base import closing_blocks as closing_blocks
from fpirhc.controllers.base import reference_block as reference_block
from fpirhc.controllers.built import Built as Built
from fpirhc.controllers.built import build as build
from fpirhc.controllers.contract import Controller as Controller
from fpirhc.controllers.contract import ControllerWrapper as ControllerWrapper
from fpirhc.controllers.contract import Undeformed as Undeformed
from fpirhc.deformation.base import Deformation as Deformation
from fpirhc.deformation.base import Form as Form
from fpirhc.deformation.base import Wrapper as Wrapper
from fpirhc.horizon.problem import reduced_gradient as reduced_gradient
from fpirhc.learning.estimators import ParameterEstimator as ParameterEstimator
from fpirhc.optimisers import Optimiser as Optimiser
from fpirhc.optimisers import clip as clip
from fpirhc.optimisers import judge as judge
from fpirhc.optimisers import remembered_plan as remembered_plan
from fpirhc.optimisers import sane as sane
from fpirhc.optimisers import shift as shift
from fpirhc.optimisers import status_of as status_of
from fpirhc.sensing.base import DerivativeEstimator as DerivativeEstimator
from fpirhc.sensing.base import StateObserver as StateObserver
from fpirhc.sensing.base import values_of as values_of
from fpirhc.symbolic.block import Block as Block
from fpirhc.symbolic.block import Delay as Delay
from fpirhc.symbolic.expression import is_finite as is_finite
from fpirhc.symbolic.layout import Layout as Layout
from fpirhc.symbolic.layout import Signal as Signal
from fpirhc.symbolic.layout import like as like
from fpirhc.symbolic.layout import scalar as scalar
from fpirhc.symbolic.layout import vector as vector
from fpirhc.task.disturbance import Disturbance as Disturbance
from fpirhc.tracking.base import Tracking as Tracking
from fpirhc.tracking.base import error_chains as error_chains
from fpirhc.tracking.base import error_signal as error_signal
