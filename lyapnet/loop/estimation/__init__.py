"""States that are not measured: their estimates from noisy readings, and whether readings tell them."""
