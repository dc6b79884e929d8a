"""The space that is searched: bounded parameters with units, its passive part, and the points and lattices on which a
function is maximised.

Imports the mechanics and `kernels`.
"""
