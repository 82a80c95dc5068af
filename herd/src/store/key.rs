//! Which keys are allowed: those that every backend can hold.

use super::StoreError;

/// Longest key in bytes: S3 allows 1024, and a store's own prefix comes before ours.
const MAX_KEY: usize = 800;
/// Longest segment in bytes: a file name may have 255.
const MAX_SEGMENT: usize = 200;

/// Checks a key: 1 to 800 bytes, `/`-separated segments of 1 to 200 bytes of `[A-Za-z0-9._-]`, none beginning with a dot.
///
/// No leading dot means no `.` and no `..`, and leaves hidden names to the backends (temporary files, MinIO's own).
pub fn check_key(key: &str) -> Result<(), StoreError> {
    check_prefix(key)?;
    if key.is_empty() {
        return invalid(key, "it is empty");
    }
    if key.ends_with('/') {
        return invalid(key, "it ends with a slash");
    }
    Ok(())
}

/// Checks what `list` is given: the beginning of a key, or nothing.
pub fn check_prefix(prefix: &str) -> Result<(), StoreError> {
    if prefix.len() > MAX_KEY {
        return invalid(&prefix[..prefix.floor_char_boundary(80)], "it is longer than 800 bytes");
    }
    let mut segments = prefix.split('/').peekable();
    while let Some(segment) = segments.next() {
        // the last segment may be cut anywhere, even before its first byte
        if segment.is_empty() && (segments.peek().is_some()) {
            return invalid(prefix, "it has an empty segment");
        }
        if segment.len() > MAX_SEGMENT {
            return invalid(prefix, "a segment is longer than 200 bytes");
        }
        if segment.starts_with('.') {
            return invalid(prefix, "a segment begins with a dot");
        }
        if !segment.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-')) {
            return invalid(prefix, "only letters, digits, dot, underscore, hyphen and slash are allowed");
        }
    }
    Ok(())
}

fn invalid(key: &str, message: &str) -> Result<(), StoreError> {
    Err(StoreError::InvalidKey { key: key.to_owned(), message: message.to_owned() })
}
