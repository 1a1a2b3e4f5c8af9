"""The report of a comparison, from whatever results there are: tables, figures, every number, and TensorBoard."""

from lyapnet.comparison.report.alternatives import brief_alternatives
from lyapnet.comparison.report.details import summary
from lyapnet.comparison.report.writing import write_report

__all__ = ["brief_alternatives", "summary", "write_report"]
