//! From a job to its prepared scene: what `render`, `prepare` and `replay` begin with.

use std::path::{Path, PathBuf};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressState, ProgressStyle};
use rayherd_api::RenderJobSpec;
use rayherd_herd::job::spec::{import_options, prepare_settings};
use rayherd_render::skip::Skips;
use rayherd_scene::import::{DescriptionSource, StreamOptions, import};
use rayherd_scene::objects::ObjectStore;
use rayherd_scene::prepare::{PrepareProgress, Prepared, SpoolSettings, Stage, prepare, source_files};

use crate::log::bars;
use crate::output::distinct;
use crate::progress::si;

/// A scene that was imported and prepared.
pub struct Opened {
    /// The scene.
    pub prepared: Prepared,
    /// Bytes of vertices that went to temporary files.
    pub vertices_spilled: u64,
    /// Cells of volumes that were not looked into.
    pub cells_passed: u64,
}

/// Imports and prepares the scene of a job that was checked. Refuses when one of `outputs`, which are to be written, is a file of the
/// scene.
pub fn open(
    spec: &RenderJobSpec,
    objects: &dyn ObjectStore,
    outputs: &[PathBuf],
    skips: Skips,
) -> anyhow::Result<Opened> {
    if spec.scene.prepared.is_some() {
        anyhow::bail!(
            "spec.scene.prepared names a scene in a cluster's storage: give its source (spec.scene.source, or SCENE)"
        );
    }
    let scene = Path::new(&spec.scene.source);
    distinct::check_inputs(outputs, [scene])?;
    let description = import(scene, &import_options(spec))?;
    distinct::check_inputs(outputs, source_files(&description))?;
    for s in &description.substitutions {
        tracing::warn!("{}: {} is not supported; in its place: {}", s.place, s.what, s.stand_in);
    }
    for note in &description.notes {
        tracing::warn!("{}: {}", note.place, note.text);
    }
    let source = DescriptionSource::new(&description, StreamOptions { skips, ..StreamOptions::default() });
    let progress = StageBar::new();
    let spool = SpoolSettings { skips, ..SpoolSettings::default() };
    let prepared = prepare(&description, &source, &prepare_settings(spec), &spool, objects, &progress);
    progress.finish();
    let prepared = prepared.with_context(|| format!("cannot prepare {}", spec.scene.source))?;
    Ok(Opened { prepared, vertices_spilled: source.spilled_bytes(), cells_passed: source.cells_passed() })
}

/// Shows the stages of preparing on a terminal.
struct StageBar(ProgressBar);

impl StageBar {
    fn new() -> Self {
        let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::hidden());
        let bar = if std::io::IsTerminal::is_terminal(&std::io::stderr()) { bars().add(bar) } else { bar };
        StageBar(bar)
    }
    fn finish(&self) {
        self.0.finish_and_clear();
        bars().remove(&self.0);
    }
}

impl PrepareProgress for StageBar {
    fn begin(&self, stage: Stage, total: Option<u64>) {
        let (what, unit) = match stage {
            Stage::Bounds => ("reading for bounds", "records"),
            Stage::Reading => ("reading", "records"),
            Stage::Counting => ("counting cells", "splits"),
            Stage::Building => ("building", "splits"),
            Stage::Reducing => ("reducing overlap", "groups"),
        };
        tracing::info!("preparing: {what}");
        let template = match total {
            Some(_) => format!("{what} {{wide_bar:.cyan/blue}} {{human_pos}} of {{human_len}} {unit}"),
            None => format!("{what} {{human_pos}} {unit} {{rate}}"),
        };
        if let Ok(style) = ProgressStyle::with_template(&template) {
            let rate = |state: &ProgressState, out: &mut dyn std::fmt::Write| {
                // what is shown of a bar cannot fail the work
                let _ = write!(out, "{}/s", si(state.per_sec()));
            };
            self.0.set_style(style.with_key("rate", rate));
        }
        self.0.reset();
        if let Some(total) = total {
            self.0.set_length(total);
        }
    }
    fn advance(&self, steps: u64) {
        self.0.inc(steps);
    }
}
/// `cornell-box` of `examples/cornell-box.xml`, `chest` of `scans/chest/`, `head` of `head.nii.gz`.
pub fn name(source: &str) -> String {
    let path = PathBuf::from(source.trim_end_matches('/'));
    let path = std::fs::canonicalize(&path).unwrap_or(path);
    let name = path.file_name().map_or_else(|| "scene".into(), |n| n.to_string_lossy().into_owned());
    if path.is_dir() {
        return name;
    }
    let name = name.strip_suffix(".gz").unwrap_or(&name);
    match name.rsplit_once('.') {
        Some((stem, _)) if !stem.is_empty() => stem.to_owned(),
        _ => name.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_is_named_after_its_file() {
        for (source, want) in [
            ("none/cornell-box.xml", "cornell-box"),
            ("head.nii.gz", "head"),
            ("chest/", "chest"),
            (".hidden", ".hidden"),
            ("/", "scene"),
        ] {
            assert_eq!(name(source), want);
        }
        assert_eq!(name("src"), "src");
        assert_eq!(name("."), "cli");
    }
}
