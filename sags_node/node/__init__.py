"""A running node: its threads and the slots between them, views, health, and what clients may ask.

Imports config, detail, engine, kernels, mapping, messaging, model, pipeline and sources.
"""
