"""Exchange with other programs: imported laws, exported laws, and an interactive page."""
