"""The ground: boxes, obstacles, terrains, and maps made from scans."""
