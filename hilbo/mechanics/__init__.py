"""The fractional-order standard linear solid: memory, recursion, exact responses, materials, switching, and the
certificate of passivity.

Imports `numerics`; `hilbo.viscoelastic` and `hilbo.passivity` are its public face.
"""
