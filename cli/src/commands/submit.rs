//! `rayherd submit`: a render on a cluster.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use bytes::Bytes;
use clap::Args;
use rayherd_api::{RenderJob, RenderJobSpec, Strategy};
use rayherd_herd::store::check_key;
use rayherd_scene::inspect::size;

use super::print;
use crate::cluster::{Cluster, ClusterOptions};
use crate::fault::Mistake;
use crate::image_options::ImageOptions;
use crate::job_file::parse_job;
use crate::options::{self, CutOptions, SceneOptions};
use crate::store::{S3Options, Store};

/// Between two looks at a job that is watched.
const LOOK: Duration = Duration::from_millis(500);
/// Most files that are uploaded for one scene: more are a folder that was meant otherwise.
const MOST_FILES: usize = 100_000;

/// Have a scene rendered by a cluster: a job file, or a scene with the flags of `render`
///
/// A scene's files (what lies beside and below a scene file, or in a folder) are uploaded to the cluster's storage first, under the hash of
/// their content: what is there already is not sent again.
#[derive(Args)]
#[command(after_help = "Examples:\n  rayherd submit job.yaml --watch\n  \
    rayherd submit scene.xml --store s3://rayherd --s3-endpoint http://localhost:9000 --spp 256 --workers 3 --watch -o out.exr")]
pub struct Arguments {
    /// A job file (.yaml), whose scene is in the storage; or a scene on this machine
    file: PathBuf,
    /// The cluster's storage as this machine reaches it: s3://bucket/prefix; to upload a scene, and to fetch the picture
    #[arg(long, value_name = "STORE")]
    store: Option<String>,
    #[command(flatten)]
    s3: S3Options,
    #[command(flatten)]
    cluster: ClusterOptions,
    /// Name of the job [default: the file's]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Wait for the end and show how far it is
    #[arg(short, long)]
    watch: bool,
    /// Fetch the picture when it is done; wants --watch and --store, and a job of one camera
    #[arg(short, long, value_name = "FILE", requires = "watch", requires = "store")]
    output: Option<PathBuf>,
    #[command(flatten)]
    scene: SceneOptions,
    #[command(flatten)]
    image: ImageOptions,
    #[command(flatten)]
    cut: CutOptions,
    /// Samples per pixel
    #[arg(long, value_name = "N", allow_hyphen_values = true, help_heading = "Sampling")]
    spp: Option<i32>,
    /// How rays and scene data meet
    #[arg(long, value_name = "NAME", help_heading = "Running")]
    strategy: Option<Strategy>,
    /// Worker pods
    #[arg(long, value_name = "N", help_heading = "Running")]
    workers: Option<i32>,
    /// Copies of everything
    #[arg(long, value_name = "N", help_heading = "Running")]
    replicas: Option<i32>,
}

/// Submits, and waits if asked to.
pub fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let file = &arguments.file;
    let is_job = file.extension().is_some_and(|e| e == "yaml" || e == "yml" || e == "json");
    let mut job = if is_job { parse_job(file)? } else { RenderJob::new(RenderJobSpec::default()) };
    let spec = &mut job.spec;
    arguments.scene.apply(spec);
    arguments.image.apply(spec);
    arguments.cut.apply(spec);
    options::set(&mut spec.sampling.spp, arguments.spp);
    options::set(&mut spec.workers.nodes, arguments.workers);
    options::set(&mut spec.replicas, arguments.replicas);
    spec.strategy = arguments.strategy.unwrap_or(spec.strategy);
    let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let name = arguments.name.clone().or(job.metadata.name.clone()).unwrap_or_else(|| name_of(&stem));
    job.metadata.name = Some(name.clone());
    let store = arguments.store.as_deref().map(|address| Store::existing(address, &arguments.s3)).transpose()?;
    if !is_job {
        let Some(store) = &store else {
            let told = "a scene on this machine is uploaded first: say where to with --store (and --s3-endpoint)";
            return Err(Mistake(told.into()).into());
        };
        job.spec.scene.source = upload(store, file)?;
    }
    options::check(&job, is_job.then_some(file.as_path()))?;
    let cluster = Cluster::connect(&arguments.cluster)?;
    cluster.apply(&job)?;
    print(&format!("renderjob.rayherd.io/{name} submitted in namespace {}\n", cluster.namespace()))?;
    if !arguments.watch {
        return Ok(ExitCode::SUCCESS);
    }
    watch(&cluster, &name)?;
    if let (Some(output), Some(store)) = (&arguments.output, &store) {
        let picture = job.spec.image.output.clone().unwrap_or_else(|| format!("{name}.exr"));
        let key = format!("output/{}/{name}/{picture}", cluster.namespace());
        let body = store.wait(store.blocks.get(&key)).with_context(|| format!("cannot fetch {key}"))?;
        fs::write(output, &body).with_context(|| format!("cannot write {}", output.display()))?;
        print(&format!("{}: {}\n", output.display(), size(body.len() as u64)))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Shows each change until the job has come to its end.
fn watch(cluster: &Cluster, name: &str) -> anyhow::Result<()> {
    let mut said = String::new();
    loop {
        let job = cluster.job(name)?;
        let line = format!("{} {} workers {}", job.phase, job.progress, job.workers);
        if line != said {
            eprintln!("{line}");
            said = line;
        }
        match (job.phase.as_str(), job.why) {
            ("Complete", _) => return Ok(()),
            ("Failed", why) => return Err(Mistake(format!("job {name} failed: {}", why.unwrap_or_default())).into()),
            _ => std::thread::sleep(LOOK),
        }
    }
}

/// A name that Kubernetes takes, like that of a file.
fn name_of(stem: &str) -> String {
    let lower = stem.to_ascii_lowercase();
    let plain: String = lower.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
    let name: String = plain.trim_matches('-').chars().take(50).collect();
    if name.is_empty() { "scene".into() } else { name.trim_end_matches('-').into() }
}

/// Uploads a scene with what lies beside it; its key.
fn upload(store: &Store, source: &Path) -> anyhow::Result<String> {
    let is_folder =
        fs::metadata(source).map_err(|e| Mistake(format!("cannot read {}: {e}", source.display())))?.is_dir();
    let folder = if is_folder { source } else { source.parent().unwrap_or(Path::new("")) };
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let files = files_below(folder)?;
    // the name is made of all names and contents: two scenes never share one, and the same scene is there already
    let mut hasher = blake3::Hasher::new();
    for (key, path) in &files {
        let mut file = blake3::Hasher::new();
        let read = fs::File::open(path).and_then(|f| file.update_reader(f).map(drop));
        read.with_context(|| format!("cannot read {}", path.display()))?;
        hasher.update(key.as_bytes()).update(&[0]).update(file.finalize().as_bytes());
    }
    let own = source.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_else(|| "scene".into());
    let prefix = format!("scenes/{}-{}", name_of(&own), &hasher.finalize().to_hex()[..16]);
    let there: Vec<(String, u64)> = store.wait(store.blocks.list(&format!("{prefix}/")))?;
    let (mut sent, mut bytes) = (0, 0);
    for (key, path) in &files {
        let key = format!("{prefix}/{key}");
        check_key(&key).map_err(|e| Mistake(format!("{}: {e}: rename it", path.display())))?;
        let length = fs::metadata(path).with_context(|| format!("cannot read {}", path.display()))?.len();
        // whole objects only: what an upload that was cut off has left is whole
        if there.contains(&(key.clone(), length)) {
            continue;
        }
        let body = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        eprintln!("{} ({})", path.display(), size(length));
        store
            .wait(store.blocks.put(&key, Bytes::from(body)))
            .with_context(|| format!("cannot upload {}", path.display()))?;
        (sent, bytes) = (sent + 1, bytes + length);
    }
    eprintln!("{sent} of {} files uploaded, {}", files.len(), size(bytes));
    Ok(if is_folder { prefix } else { format!("{prefix}/{own}") })
}

/// All files below a folder but hidden ones, by key relative to it, ascending.
fn files_below(folder: &Path) -> anyhow::Result<Vec<(String, PathBuf)>> {
    let mut found = Vec::new();
    let mut folders = vec![(String::new(), folder.to_owned())];
    while let Some((prefix, folder)) = folders.pop() {
        let read = |e| anyhow::Error::new(e).context(format!("cannot read {}", folder.display()));
        for entry in fs::read_dir(&folder).map_err(read)? {
            let entry = entry.map_err(read)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if name.starts_with('.') {
                continue;
            }
            let (key, path) = (format!("{prefix}{name}"), entry.path());
            if fs::metadata(&path).map_err(read)?.is_dir() {
                folders.push((format!("{key}/"), path));
            } else {
                found.push((key, path));
            }
            if found.len() > MOST_FILES {
                let told = "has more than 100000 files: put the scene into a folder of its own";
                return Err(Mistake(format!("{} {told}", folder.display())).into());
            }
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_job_is_named_after_its_file() {
        for (stem, name) in [("Cornell Box", "cornell-box"), ("a.b_c", "a-b-c"), ("--", "scene"), ("x", "x")] {
            assert_eq!(name_of(stem), name);
        }
    }

    #[test]
    fn a_scene_is_uploaded_once_with_what_lies_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("scene");
        fs::create_dir_all(scene.join("textures")).unwrap();
        for (name, body) in [("room.xml", "<scene/>"), ("textures/a.png", "png"), (".hidden", "x")] {
            fs::write(scene.join(name), body).unwrap();
        }
        let place = folder.path().join("store");
        let store = Store::open(place.to_str().unwrap(), &S3Options::default()).unwrap();
        let list = || store.wait(store.blocks.list("scenes/")).unwrap();
        let key = upload(&store, &scene.join("room.xml")).unwrap();
        assert!(key.starts_with("scenes/room-xml-") && key.ends_with("/room.xml"), "{key}");
        let first = list();
        assert_eq!(first.len(), 2, "{first:?}");
        assert_eq!(upload(&store, &scene.join("room.xml")).unwrap(), key);
        // cut off: the rest is sent
        store.wait(store.blocks.delete(std::slice::from_ref(&key))).unwrap();
        assert_eq!(upload(&store, &scene.join("room.xml")).unwrap(), key);
        assert_eq!(list(), first);
        fs::write(scene.join("textures/a.png"), "other").unwrap();
        assert_ne!(upload(&store, &scene.join("room.xml")).unwrap(), key, "another content has another name");
        let all = upload(&store, &scene).unwrap();
        assert!(all.starts_with("scenes/scene-") && !all.ends_with(".xml"));
        fs::write(scene.join("with space.ply"), "x").unwrap();
        assert!(upload(&store, &scene).unwrap_err().to_string().contains("rename it"));
    }
}
