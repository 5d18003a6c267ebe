"""A page in the browser over the runs of a folder: what goes on, what is asked, and a stop."""
