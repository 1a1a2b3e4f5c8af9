"""A controller's law as C99, an FMU, structured text, ONNX, torch.export or CasADi, compared with the controller."""

from lyapnet.exchange.export.certified import CertifiedFiles
from lyapnet.exchange.export.writing import FORMATS, Exported, compiled, export

__all__ = ["FORMATS", "CertifiedFiles", "Exported", "compiled", "export"]
