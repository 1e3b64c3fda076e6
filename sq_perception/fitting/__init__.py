"""Iterative fits: the classic method of Solina and Bajcsy, and the exact surface fit."""
