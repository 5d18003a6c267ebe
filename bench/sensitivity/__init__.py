"""How detectors' errors grow with one quantity at a time, beside what physics allows: `teatbench scene sensitivity`."""
