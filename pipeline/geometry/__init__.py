"""Pure functions on numpy arrays: meshes, voxels, rigid motion, surfaces, landmarks."""
