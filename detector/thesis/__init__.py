"""The published algorithm (thesis, chapter 4, appendix A), stage by stage: the baseline."""
