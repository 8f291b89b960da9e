"""A package of its own that adds an environment and a method to popgen: the example of docs/adding.md.

Its pyproject.toml would say

    [project.entry-points."popgen.environments"]
    line = "toy_popgen.line_family:FAMILY"
    [project.entry-points."popgen.methods"]
    guess = "toy_popgen.guess_method:METHOD"
"""
