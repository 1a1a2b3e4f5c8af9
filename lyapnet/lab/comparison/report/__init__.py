"""The report of a comparison from the results that exist: tables, figures, all numbers, and TensorBoard."""

from lyapnet.lab.comparison.report.alternatives import brief_alternatives
from lyapnet.lab.comparison.report.details import summary
from lyapnet.lab.comparison.report.mean_costs import mean_costs
from lyapnet.lab.comparison.report.writing import write_report

__all__ = ["brief_alternatives", "mean_costs", "summary", "write_report"]
