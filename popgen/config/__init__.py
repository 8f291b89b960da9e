"""Frozen schemas, checked before anything starts.

`schema` holds the base class and number types, `sections` the sections that every run has, `run_config` the whole of
a run. The sections of a method stand with the method (`popgen/methods/*/config.py`). The schemas know nothing of
Hydra: the command line composes a plain dictionary and calls `RunConfig.parse`.
"""
