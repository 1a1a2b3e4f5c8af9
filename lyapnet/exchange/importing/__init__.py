"""V(x) and u(x) of other tools, as functions in Python or ONNX files, for certificates."""

from lyapnet.exchange.importing.files import imported_controller
from lyapnet.exchange.importing.law import GivenLaw, GivenValue, controller_of

__all__ = ["GivenLaw", "GivenValue", "controller_of", "imported_controller"]
