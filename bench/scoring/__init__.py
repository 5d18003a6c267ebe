"""Scores as pure functions: arrays in, values out; knows no instrument, no detector, no file, no clock.

Lowest first: `points` < `matching`, `errors`, `rates`, `tolerance`, `limits`, `paired`, `gage`, `plane`, `ellipsoid` < `trends`, `power`,
`decisions`, `scene` < `error_decision`, `pool`, `comparison`. Counts are added and ratios derived at the end; what was never measured is
None ("not measured"), never 0 and never 100 %. Every formula with its source: docs/scoring.md.
"""
