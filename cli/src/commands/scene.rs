//! `rayherd scene`: larger and worse-ordered scenes out of one.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand};
use rayherd_scene::house::{House, MOST_PER_METRE, house};
use rayherd_scene::import::{DescriptionSource, ImportOptions, StreamOptions, import_surface};
use rayherd_scene::many_lights::{MOST_LAMPS, many_lights};
use rayherd_scene::prepare::source_files;
use rayherd_scene::record::RecordSource;
use rayherd_scene::tools::{self, ToolError, Written};

use super::{print, size};
use crate::options::numbers;
use crate::output::{distinct, replace};

/// Make a larger or worse-ordered scene out of one, or a room to measure with
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd scene subdivide bunny.ply -o big.ply --levels 2\n  \
    rayherd scene replicate bunny.ply -o many.ply --copies 4,4,1 --step 0.2,0.2,0\n  \
    rayherd scene interleave many.ply -o mixed.ply --strands 32\n  \
    rayherd scene many-lights 1000 -o room.xml\n  rayherd scene house --size 4 house")]
pub struct Arguments {
    #[command(subcommand)]
    tool: Tool,
}

#[derive(Subcommand)]
enum Tool {
    /// Divide each triangle into four, again and again: the same surface of 4^LEVELS as many triangles
    #[command(after_help = "Example:\n  rayherd scene subdivide bunny.ply -o big.ply --levels 2")]
    Subdivide {
        #[command(flatten)]
        files: Files,
        /// How often, at most 8
        #[arg(long, value_name = "LEVELS", default_value_t = 1)]
        levels: u32,
    },
    /// Put copies side by side on a grid, one whole copy after another
    #[command(after_help = "Example:\n  rayherd scene replicate bunny.ply -o many.ply --copies 4,4,1 --step 0.2,0.2,0")]
    Replicate {
        #[command(flatten)]
        files: Files,
        /// Copies along x, y and z
        #[arg(long, value_name = "X,Y,Z", value_parser = three::<u32>)]
        copies: [u32; 3],
        /// Distances from one copy to the next along x, y and z
        #[arg(long, value_name = "X,Y,Z", value_parser = three::<f64>, allow_hyphen_values = true)]
        step: [f64; 3],
    },
    /// Cut the triangles into equal runs and take one of each in turn: near in the file is far in the scene
    #[command(after_help = "Example:\n  rayherd scene interleave many.ply -o mixed.ply --strands 32")]
    Interleave {
        #[command(flatten)]
        files: Files,
        /// Number of runs, at most 4096; with as many as splits every split spans the scene
        #[arg(long, value_name = "N")]
        strands: u32,
    },
    /// A room under so many small lamps, as Mitsuba XML; the same every time
    #[command(
        after_help = "Example:\n  rayherd scene many-lights 1000 -o room.xml && rayherd render room.xml --spp 16"
    )]
    ManyLights {
        /// Number of lamps, at most 100000
        #[arg(value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_LAMPS)))]
        lamps: u32,
        /// The XML to write
        #[arg(short, long, value_name = "XML")]
        output: PathBuf,
    },
    /// A textured house in badly ordered files, as fine as wanted; the same every time
    ///
    /// Writes house.xml with an OBJ file for each material, house.mtl and PNG textures: `rayherd render DIR` takes the MTL's materials.
    #[command(after_help = "Example:\n  rayherd scene house --size 4 house && rayherd render house/house.xml --spp 16")]
    House {
        /// Squares along a metre: 1 makes 1,960 triangles, 10 makes 127,628; at most 256
        #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..=i64::from(MOST_PER_METRE)))]
        size: u32,
        /// The folder to write into; it is made if need be
        folder: PathBuf,
    },
}

#[derive(Args)]
struct Files {
    /// Mitsuba XML, mesh, folder of meshes, or volume
    scene: PathBuf,
    /// The PLY to write
    #[arg(short, long, value_name = "PLY")]
    output: PathBuf,
    /// Value of the surface to extract from a volume
    #[arg(long, value_name = "VALUE", allow_negative_numbers = true)]
    iso: Option<f64>,
}

/// Runs the tool and says what was written.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let (files, written) = match &arguments.tool {
        Tool::Subdivide { files, levels } => (files, write(files, |s, out| tools::subdivide(s, *levels, out))?),
        Tool::Replicate { files, copies, step } => {
            (files, write(files, |s, out| tools::replicate(s, *copies, *step, out))?)
        }
        Tool::ManyLights { lamps, output } => {
            replace::probe(output, "-o")?;
            let text = many_lights(*lamps);
            replace::replace_or_keep(output, text.as_bytes())?;
            print(&format!("{}: {lamps} lamps, {}\n", output.display(), size(text.len() as u64)))?;
            return Ok(ExitCode::SUCCESS);
        }
        Tool::House { size: per_metre, folder } => {
            let House { triangles, bytes } = house(*per_metre, folder)?;
            print(&format!("{}: {triangles} triangles, {}\n", folder.display(), size(bytes)))?;
            return Ok(ExitCode::SUCCESS);
        }
        Tool::Interleave { files, strands } => (files, write(files, |s, out| tools::interleave(s, *strands, out))?),
    };
    let Written { read, triangles, bytes } = written;
    print(&format!("{}: {triangles} triangles of {read}, {}\n", files.output.display(), size(bytes)))?;
    Ok(ExitCode::SUCCESS)
}

fn write(
    files: &Files,
    tool: impl FnOnce(&dyn RecordSource, &Path) -> Result<Written, ToolError>,
) -> anyhow::Result<Written> {
    replace::probe_file(&files.output, "-o")?;
    distinct::check_inputs(std::slice::from_ref(&files.output), [files.scene.as_path()])?;
    let options = ImportOptions { iso: files.iso, ..ImportOptions::default() };
    let description = import_surface(&files.scene, &options)?;
    distinct::check_inputs(std::slice::from_ref(&files.output), source_files(&description))?;
    Ok(tool(&DescriptionSource::new(&description, StreamOptions::default()), &files.output)?)
}

fn three<T: std::str::FromStr>(text: &str) -> Result<[T; 3], String> {
    <[T; 3]>::try_from(numbers(text)?).map_err(|n| format!("has {} numbers: give three, X,Y,Z", n.len()))
}
