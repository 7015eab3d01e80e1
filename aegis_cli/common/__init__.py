"""What any module may use: errors, events, files, artifacts, devices, pictures."""
