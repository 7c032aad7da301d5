"""Solids whose thin parts stay in one piece."""
