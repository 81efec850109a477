"""Camera sources: video files, image folders, stereo heads, RTSP streams, V4L2 devices."""
