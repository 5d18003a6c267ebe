"""The published algorithm (chapter 4 and appendix A of the thesis), stage by stage: the baseline of
every comparison.
"""
