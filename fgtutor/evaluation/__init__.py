"""Measuring what was built: success rates with intervals, one module per experiment.

An experiment (`matrix`, `ablation`, `sweep`) is a list of tasks (`tasks`), whose rows are kept as
they finish (`shards`) and end in a folder with a table (`report`). `report` says how to add
another.
"""
