//! The `RenderJob` types, shared by the command line, the local run and the operator. Knows no client.
