//! Trees over triangles and spheres: building, storing, checking, tracing.
