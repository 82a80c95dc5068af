//! `rayherd inspect`: what a prepared scene is made of.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use rayherd_scene::inspect::{Picture, picture, summary};
use rayherd_scene::manifest::Manifest;
use rayherd_scene::objects::ObjectRef;

use super::{print, size};
use crate::fault::Mistake;
use crate::output::{png_file, replace};
use crate::store::{S3Options, Store};

/// Show what a prepared scene is made of: splits, cells, owners, copies, sizes
#[derive(Args)]
#[command(
    after_help = "The picture shows the scheduling grid as slices along z, from the lowest at the top left, row by \
    row; in a slice x goes right and y up. A cell has the colour of its owner; one with several owners shows two of \
    them in a checkerboard with a white rim.\n\n\
    Examples:\n  rayherd inspect prepared\n  rayherd inspect prepared --splits --picture grid.png"
)]
pub struct Arguments {
    /// What `rayherd prepare` filled: a folder, or s3://bucket/prefix
    prepared: String,
    #[command(flatten)]
    s3: S3Options,
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
    let (object, manifest) = choose(&arguments.prepared, &arguments.s3, arguments.scene.as_deref())?;
    let mut text = format!("scene        {}\n{}", object.hash, summary(&manifest));
    if arguments.splits {
        text += &split_table(&manifest);
    }
    if let Some(path) = &arguments.picture {
        let Picture { width, height, rgb } = picture(&manifest);
        let png = png_file::encode_rgb8(width, height, &rgb).context("cannot draw the grid")?;
        replace::replace(path, &png).map_err(|e| Mistake(format!("cannot write {}: {e}", path.display())))?;
        let _ = writeln!(text, "picture      {}", path.display());
    }
    print(&text)?;
    Ok(ExitCode::SUCCESS)
}

/// The one scene of a folder, or the one whose hash begins with `wanted`.
fn choose(shown: &str, s3: &S3Options, wanted: Option<&str>) -> anyhow::Result<(ObjectRef, Manifest)> {
    let none =
        || Mistake(format!("{shown} holds no prepared scene: make one with `rayherd prepare SCENE --store {shown}`"));
    // a folder that is no store must not become one by looking
    if !shown.starts_with("s3://") && !Path::new(shown).join("names").is_dir() {
        return Err(none().into());
    }
    // it runs what its objects are read with
    let opened = Store::existing(shown, s3)?;
    let store = &opened.objects;
    let mut scenes: Vec<ObjectRef> = Vec::new();
    for name in store.names()?.iter().filter(|n| n.starts_with("scene-")) {
        let object = store.name(name)?.with_context(|| format!("{shown}: name {name} has gone"))?;
        if !scenes.contains(&object) && wanted.is_none_or(|w| object.hash.to_string().starts_with(w)) {
            scenes.push(object);
        }
    }
    match scenes[..] {
        [object] => {
            let manifest =
                Manifest::load(store.as_ref(), &object).with_context(|| format!("{shown}: {}", object.hash))?;
            Ok((object, manifest))
        }
        [] => Err(match wanted {
            Some(w) => Mistake(format!("{shown} holds no prepared scene whose hash begins with {w}")),
            None => none(),
        }
        .into()),
        _ => {
            let list: Vec<String> = scenes.iter().map(|s| format!("\n  {}", s.hash)).collect();
            Err(Mistake(format!("{shown} holds {} scenes, choose one with --scene:{}", list.len(), list.concat()))
                .into())
        }
    }
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
