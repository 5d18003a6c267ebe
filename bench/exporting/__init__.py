"""A run's record for other programs: `tables` (CSV, Parquet) and `mcap_file` (MCAP, for Foxglove and its kin). Reads; never judges.

The libraries for Parquet and MCAP are an extra (``pip install "teatbench[export]"``), and are imported when they are needed.
"""
