"""Files that people make, read or keep: paths, rigs, arms, poses, meshes, images, session folders."""
