"""The run folder: what was asked for, what happened, and the frames. Opens after any death of the bench.

``runs/<time>-<script>/`` holds the script, rig and calibration as used, ``run.sqlite`` (write-ahead log, full sync) and
``frames/<trial>/<camera>.png``. `schema` says what the tables are, `reading` opens runs of any age, `folder` is the one writer,
`transactions` puts its rows on the disk, `chain` ties each write to all before it, `files` puts files on the disk, `check` looks whether
all is as it was written.
"""

from bench.store.files import Picture, png_bytes, write_synced
from bench.store.folder import FinishedTrial, FolderGoneError, Store, new_run_folder
from bench.store.schema import DATABASE, GUARDIAN, RULES, SCHEMA_VERSION, SCRIPT
from bench.store.transactions import Row

__all__ = [
    "DATABASE",
    "GUARDIAN",
    "RULES",
    "SCHEMA_VERSION",
    "SCRIPT",
    "FinishedTrial",
    "FolderGoneError",
    "Picture",
    "Row",
    "Store",
    "new_run_folder",
    "png_bytes",
    "write_synced",
]
