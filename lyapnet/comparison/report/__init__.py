"""The report of a comparison, from whatever results there are: tables, figures, every number, and TensorBoard."""

from lyapnet.comparison.report.alternatives import brief
from lyapnet.comparison.report.details import summary
from lyapnet.comparison.report.writing import write_report

__all__ = ["brief", "summary", "write_report"]
