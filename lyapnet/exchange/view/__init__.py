"""An interactive page of a controller: V on slices, funnels, limits and closed loops, in one file."""

from lyapnet.exchange.view.page import page_of, write_page

__all__ = ["page_of", "write_page"]
