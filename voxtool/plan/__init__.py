"""The plan: what a scene needs, what is left out and why, and what it will cost.

It knows neither meshes nor devices.
"""
