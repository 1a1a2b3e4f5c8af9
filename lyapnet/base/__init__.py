"""General tools without control theory: errors, files, shapes, small matrices, tables."""
