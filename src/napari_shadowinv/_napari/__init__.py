"""The napari plugin: layers of a result, readers, writers, sample data, commands, widgets.

Nothing else in the package imports it, and it imports napari only inside functions: layers are
described as tuples (data, keywords, type), which need no window.
"""
