"""A controller's law in other languages: C99, ONNX, or a program of torch's own; each held against the controller."""

from lyapnet.export.export import FORMATS, Exported, export

__all__ = ["FORMATS", "Exported", "export"]
