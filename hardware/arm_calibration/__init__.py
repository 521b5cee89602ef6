"""`stillbed calibrate arm`: the arm moves before the cameras, and what they see of its tip says where and how it is."""
