"""Widgets of the notebooks: drag the taus, paint a terrain, drive a robot."""
