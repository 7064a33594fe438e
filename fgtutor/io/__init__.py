"""Reading and writing files: maps, point clouds, records, and what keeps them whole."""
