"""A controller's law in other languages: C99, ONNX, or a program of torch's own; each held against the controller."""

from lyapnet.exchange.export.certified import CertifiedFiles
from lyapnet.exchange.export.writing import FORMATS, Exported, compiled, export

__all__ = ["FORMATS", "CertifiedFiles", "Exported", "compiled", "export"]
