//! Job files.

use std::path::{Path, PathBuf};

use rayherd_api::RenderJob;

use crate::bounded;
use crate::fault::Mistake;

/// Most bytes of a job file: it holds settings, and thousands of cameras at most.
const MOST_BYTES: u64 = 4 << 20;

/// Most characters of an error of the YAML reader.
const MOST_SAID: usize = 300;

/// Reads a job file as it stands.
pub fn parse_job(path: &Path) -> anyhow::Result<RenderJob> {
    let text = bounded::read(path, MOST_BYTES, "this is no job file")?;
    let job = serde_yaml::from_slice(&text).map_err(|e| {
        // a file that is something else may be repeated whole
        let said: String = e.to_string().chars().take(MOST_SAID).collect();
        Mistake(format!("{}: {said}; a scene is named without -f", path.display()))
    })?;
    Ok(job)
}

/// Reads a job file. A relative source is relative to the file.
pub fn read_job(path: &Path) -> anyhow::Result<RenderJob> {
    let mut job = parse_job(path)?;
    let source = PathBuf::from(&job.spec.scene.source);
    if source.is_relative() && !job.spec.scene.source.is_empty() && !job.spec.scene.source.contains("://") {
        let beside = path.parent().unwrap_or(Path::new("")).join(source);
        job.spec.scene.source = beside.to_string_lossy().into_owned();
    }
    Ok(job)
}
