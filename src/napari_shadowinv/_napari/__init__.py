"""The napari plugin: layers of a result, readers, writers, sample data, commands, widgets.

No other part of the package imports it, and it imports napari only inside functions: layers are
represented as tuples (data, keywords, type), which need no window.
"""
