"""Files that people make, read or keep: paths, rigs, arms, poses, meshes, images, session folders."""

__all__ = [
    "arm_file", "dispenser_file", "folder_tables", "images", "mesh_file", "mesh_reader", "path_file",
    "pose_file", "region_table", "rig_file", "session", "session_folder",
]  # fmt: skip
