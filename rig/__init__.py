"""The capture side: plan a field recording, drive the rig, record, check and rescue.

This room knows nothing of trajectories. It uses the shared types of recordings, and the readers and writers
of their files (:mod:`acino_fte.data_tools`).
"""
