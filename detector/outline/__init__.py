"""The outline of a teat's end as a model, its edges in pictures, and where known ends are seen."""
