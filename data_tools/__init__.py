"""Files from elsewhere into a :class:`acino_fte.sequence.Sequence`, and back.

One module per kind of file; :mod:`acino_fte.data_tools.load` puts them together. Nothing is imported
here, so that importing one reader does not load the libraries of the others.
"""
