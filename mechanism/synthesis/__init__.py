"""Dimensional synthesis: from a wanted curve to link lengths, pivots and a servo motion (paper, section 2).

Lives here: the task (what is wanted), the objective (terms of a mechanism, whole populations at a time), the methods
that search it, and what they find. May enter: nothing that reads a clock, a file or a bus; who has worker processes
hands in his own way of evaluating a population.
"""
