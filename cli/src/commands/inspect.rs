//! `rayherd inspect`: what a prepared scene is made of.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use rayherd_scene::manifest::{Manifest, StoppedBy};
use rayherd_scene::objects::{DirectoryObjects, ObjectRef, ObjectStore};

use super::print;
use crate::fault::Mistake;
use crate::output::{grid_picture, replace};

/// Show what a prepared scene is made of: splits, cells, owners, copies, sizes
#[derive(Args)]
#[command(after_help = "The picture shows the scheduling grid layer by layer along z, from left to right and top to \
    bottom; in a layer x grows to the right and y upwards. An occupied cell has the colour of its first owner, with \
    a white corner where it has several; what is dark is empty.\n\n\
    Examples:\n  rayherd inspect prepared\n  rayherd inspect prepared --splits --picture grid.png")]
pub struct Arguments {
    /// A folder that `rayherd prepare` filled
    prepared: PathBuf,
    /// Which scene, by the first digits of its hash, when the folder holds several
    #[arg(long, value_name = "HASH")]
    scene: Option<String>,
    /// List every split
    #[arg(long)]
    splits: bool,
    /// Draw the grid
    #[arg(long, value_name = "PNG")]
    picture: Option<PathBuf>,
}

/// Reads the manifest and prints.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let (object, manifest) = choose(&arguments.prepared, arguments.scene.as_deref())?;
    let mut text = summary(&object, &manifest);
    if arguments.splits {
        text += &split_table(&manifest);
    }
    if let Some(path) = &arguments.picture {
        let png = grid_picture::draw(&manifest.grid).context("cannot draw the grid")?;
        replace::replace(path, &png).map_err(|e| Mistake(format!("cannot write {}: {e}", path.display())))?;
        let _ = writeln!(text, "picture      {}", path.display());
    }
    print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// The one scene of a folder, or the one whose hash begins with `wanted`.
fn choose(folder: &Path, wanted: Option<&str>) -> anyhow::Result<(ObjectRef, Manifest)> {
    let shown = folder.display();
    if !folder.join("names").is_dir() {
        let message = format!("{shown} holds no prepared scene: make one with `rayherd prepare SCENE --store {shown}`");
        return Err(Mistake(message).into());
    }
    let store = DirectoryObjects::open(folder)?;
    let mut scenes: Vec<ObjectRef> = Vec::new();
    for name in store.names()?.iter().filter(|n| n.starts_with("scene-")) {
        let object = store.name(name)?.with_context(|| format!("{shown}: name {name} has gone"))?;
        if !scenes.contains(&object) && wanted.is_none_or(|w| object.hash.to_string().starts_with(w)) {
            scenes.push(object);
        }
    }
    match scenes[..] {
        [object] => {
            let manifest = Manifest::load(&store, &object).with_context(|| format!("{shown}: {}", object.hash))?;
            Ok((object, manifest))
        }
        [] => {
            let which = wanted.map(|w| format!(" whose hash begins with {w}")).unwrap_or_default();
            Err(Mistake(format!("{shown} holds no prepared scene{which}")).into())
        }
        _ => {
            let list: Vec<String> = scenes.iter().map(|s| format!("\n  {}", s.hash)).collect();
            Err(Mistake(format!("{shown} holds {} scenes, choose one with --scene:{}", list.len(), list.concat()))
                .into())
        }
    }
}

fn summary(object: &ObjectRef, m: &Manifest) -> String {
    let (source, copied): (Vec<_>, Vec<_>) = m.splits.iter().partition(|s| !s.copied);
    let sum = |splits: &[&rayherd_scene::manifest::SplitEntry]| {
        splits.iter().fold((0, 0), |(g, a), s| (g + s.geometry.bytes, a + s.attributes.bytes))
    };
    let (geometry, attributes) = sum(&source);
    let (copied_geometry, copied_attributes) = sum(&copied);
    let c = &m.counts;
    let cells = &m.grid.cells;
    let contested = cells.iter().filter(|cell| cell.owners.len() > 1).count();
    let most_owners = cells.iter().map(|cell| cell.owners.len()).max().unwrap_or(0);
    let stopped = match m.choice.stopped_by {
        StoppedBy::Threshold => "the share of contested primitives is low enough",
        StoppedBy::Several => "there are several times as many cells as splits",
        StoppedBy::Limit => "it is the largest subdivision allowed",
    };
    let share = m.choice.candidates.iter().find(|x| x.subdiv == m.grid.subdiv).map_or(0.0, |x| x.contested_share());
    let skipped = c.degenerate + c.non_finite + c.out_of_range;
    let mut t = String::new();
    let mut line = |name: &str, text: String| t += &format!("{name:<12} {text}\n");
    line("scene", object.hash.to_string());
    line("content", m.content.to_string());
    line("primitives", format!("{} triangles, {} spheres, {skipped} skipped", c.triangles, c.spheres));
    line("box", format!("{:?} to {:?}, recentred by {:?}", m.lo, m.hi, m.offset));
    line("splits", format!("{}: geometry {}, attributes {}", source.len(), size(geometry), size(attributes)));
    line(
        "copied",
        format!(
            "{} splits, {} primitives: geometry {}, attributes {}",
            copied.len(),
            m.choice.copies,
            size(copied_geometry),
            size(copied_attributes)
        ),
    );
    line("grid", format!("{0} x {0} x {0}, {1} cells occupied; {stopped}", m.grid.subdiv, cells.len()));
    line(
        "contested",
        format!("{} cells before overlap reduction, share {share:.3}; {contested} after", m.choice.contested_cells),
    );
    line("owners", format!("at most {most_owners} for a cell"));
    line("source", format!("read {} times, {}", c.source_reads, size(c.source_bytes)));
    for s in &m.defaults.substitutions {
        line("stand-in", format!("{}: {} for {}", s.place, s.stand_in, s.what));
    }
    t
}

fn split_table(m: &Manifest) -> String {
    let mut owned = vec![0u64; m.splits.len()];
    for cell in &m.grid.cells {
        cell.owners.iter().for_each(|&s| owned[s as usize] += 1);
    }
    let mut t = String::from("\n split   triangles  spheres    geometry  attributes  cells  ids\n");
    for (i, (s, cells)) in m.splits.iter().zip(owned).enumerate() {
        let _ = writeln!(
            t,
            "{i:>6} {:>11} {:>8} {:>11} {:>11} {cells:>6}  {}..={}{}",
            s.triangles,
            s.spheres,
            size(s.geometry.bytes),
            size(s.attributes.bytes),
            s.first_id,
            s.last_id,
            if s.copied { "  copied" } else { "" }
        );
    }
    t
}

/// A number of bytes with three or four digits.
pub fn size(bytes: u64) -> String {
    let mut value = bytes as f64;
    for unit in ["B", "KiB", "MiB", "GiB"] {
        if value < 1000.0 {
            return if unit == "B" { format!("{bytes} B") } else { format!("{value:.1} {unit}") };
        }
        value /= 1024.0;
    }
    format!("{value:.1} TiB")
}
