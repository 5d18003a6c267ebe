"""A script gone through before its run: by the real engine and drivers on an emulated twin of the rig, in virtual time.

What it writes is in a temporary folder and thrown away; no instrument is touched. `twin` makes the rig, `person` and `hands` are who is
asked, `stand_in_cameras` take no pictures but a few, `course` knows where it is and what it met, `time_spent` on what, `rehearsal` puts it
together.
"""
