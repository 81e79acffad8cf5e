"""An experiment of two methods, whose images are tiny and whose budget is in samples."""
TOML = """
title = "Test"
seeds = 2
[budget]
spp = 11
checkpoints = 3
[[scene]]
name = "cornell_box"
width = 16
height = 12
max_depth = 4
[[method]]
name = "Path tracing"
[[method]]
name = "Roulette"
integrator = { roulette = "throughput" }
"""
