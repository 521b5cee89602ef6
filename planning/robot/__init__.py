"""The arm as a machine: kinematics, joints, and what of a path it can reach."""
