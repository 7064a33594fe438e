"""Measuring what was built: success rates with intervals, one module per experiment."""
