"""From measurements to parameters: a material from creep and relaxation tests, and a device's own damping.

Imports the mechanics, `hardware_bridge` for what a device measures by itself, and the readers of tables in `study`.
"""
