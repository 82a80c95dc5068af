//! Job files.

use std::path::{Path, PathBuf};

use rayherd_api::RenderJob;

use crate::fault::Mistake;

/// Reads a job file. A relative source is relative to the file.
pub fn read_job(path: &Path) -> anyhow::Result<RenderJob> {
    let text = std::fs::read_to_string(path).map_err(|e| Mistake(format!("cannot read {}: {e}", path.display())))?;
    let mut job: RenderJob = serde_yaml::from_str(&text).map_err(|e| Mistake(format!("{}: {e}", path.display())))?;
    let source = PathBuf::from(&job.spec.scene.source);
    if source.is_relative() && !job.spec.scene.source.is_empty() && !job.spec.scene.source.contains("://") {
        let beside = path.parent().unwrap_or(Path::new("")).join(source);
        job.spec.scene.source = beside.to_string_lossy().into_owned();
    }
    Ok(job)
}
