"""Pictures, videos and the course's tools."""
