//! `rayherd submit`: a render on a cluster.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::Context;
use bytes::Bytes;
use clap::Args;
use rayherd_api::{PREVIEW, PictureFile, RenderJob, RenderJobSpec, Strategy};
use rayherd_herd::remote::frames::preview_key;
use rayherd_herd::store::StoreError;
use rayherd_scene::inspect::size;

use super::print;
use crate::cluster::{Cluster, ClusterOptions};
use crate::fault::Mistake;
use crate::frames;
use crate::image_options::ImageOptions;
use crate::job_file::parse_job;
use crate::options::{self, CutOptions, SceneOptions};
use crate::output::{distinct, replace};
use crate::store::{S3Options, Store};
use crate::upload::{name_of, upload};

/// Between two looks at a job that is watched.
const LOOK: Duration = Duration::from_millis(500);
/// Between two looks for its preview.
const LOOK_FOR_PREVIEW: Duration = Duration::from_secs(2);

/// Have a scene rendered by a cluster: a job file, or a scene with the flags of `render`
///
/// A scene's files (what lies beside and below a scene file, or in a folder) are uploaded to the cluster's storage first, under the hash of
/// their content: what is there already is not sent again, and what was cut off is gone on with, within a file too.
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
    /// Fetch the picture when it is done, the PNG if FILE ends in .png, else the EXR; wants --watch and --store. Of several cameras each has
    /// a file of its own, FILE-CAMERA.exr
    #[arg(short, long, value_name = "FILE", requires = "watch", requires = "store")]
    output: Option<PathBuf>,
    /// Have a preview made from time to time, every 30 s at most, and fetch it to FILE, a PNG; wants --watch and --store. Pixels whose
    /// rays are under way are too dark in it. Of several cameras it is the one that is being rendered
    #[arg(long, value_name = "FILE", requires = "watch", requires = "store")]
    preview: Option<PathBuf>,
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
    // before anything is sent: what is wrong with a flag, or with the way to the cluster
    if let Some(output) = &arguments.output {
        replace::probe(output, "-o")?;
        check_written(&job, output)?;
    }
    if let Some(preview) = &arguments.preview {
        check_preview(preview, arguments.output.as_ref())?;
        job.metadata.annotations.insert(PREVIEW.into(), "true".into());
    }
    let cluster = Cluster::connect(&arguments.cluster)?;
    if !is_job {
        let Some(store) = &store else {
            let told = "a scene on this machine is uploaded first: say where to with --store (and --s3-endpoint)";
            return Err(Mistake(told.into()).into());
        };
        job.spec.scene.source = upload(store, file)?;
    }
    options::check(&job, is_job.then_some(file.as_path()))?;
    cluster.apply(&job)?;
    print(&format!("renderjob.rayherd.io/{name} submitted in namespace {}\n", cluster.namespace()))?;
    if !arguments.watch {
        return Ok(ExitCode::SUCCESS);
    }
    let mut preview = arguments.preview.as_deref().zip(store.as_ref()).map(|(file, store)| Preview::new(store, file));
    watch(&cluster, &name, preview.as_mut())?;
    if let (Some(output), Some(store)) = (&arguments.output, &store) {
        for (key, path) in pictures(&job, cluster.namespace(), output) {
            let body = store.wait(store.blocks.get(&key)).with_context(|| format!("cannot fetch {key}"))?;
            replace::replace_or_keep(&path, &body)?;
            print(&format!("{}: {}\n", path.display(), size(body.len() as u64)))?;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Which of the picture's files goes to a file here.
fn kind_of(output: &Path) -> PictureFile {
    if output.extension().is_some_and(|e| e == "png") { PictureFile::Png } else { PictureFile::Exr }
}

fn check_written(job: &RenderJob, output: &Path) -> Result<(), Mistake> {
    let kind = kind_of(output).extension();
    if job.spec.image.writes(kind_of(output)) {
        return Ok(());
    }
    let path = output.display();
    Err(Mistake(format!(
        "-o {path} is to be the {kind}, which this job does not write: name {kind} in --files (spec.image.files) too"
    )))
}

fn check_preview(preview: &Path, output: Option<&PathBuf>) -> anyhow::Result<()> {
    if preview.extension().is_none_or(|e| e != "png") {
        let told = format!("--preview {} is a PNG: name a file that ends in .png", preview.display());
        return Err(Mistake(told).into());
    }
    replace::probe(preview, "--preview")?;
    let all: Vec<PathBuf> = output.into_iter().cloned().chain([preview.to_owned()]).collect();
    Ok(distinct::check_outputs(&all)?)
}

/// The preview of a job in its storage, and the file here that follows it.
struct Preview<'a> {
    store: &'a Store,
    file: &'a Path,
    /// As it was fetched last, and what the store knows it by, if it does.
    tag: Option<String>,
    body: Bytes,
    looked: Option<Instant>,
}

impl<'a> Preview<'a> {
    fn new(store: &'a Store, file: &'a Path) -> Self {
        Preview { store, file, tag: None, body: Bytes::new(), looked: None }
    }

    /// Fetches it if it has changed; whether it has.
    fn fetch(&mut self, uid: &str) -> anyhow::Result<bool> {
        let key = preview_key(&format!("jobs/{uid}"));
        let mut tag = None;
        if let Some(found) = self.store.wait(self.store.blocks.list_versions(&key))? {
            let Some(version) = found.into_iter().find(|v| v.key == key) else { return Ok(false) };
            if self.tag.as_ref() == Some(&version.tag) {
                return Ok(false);
            }
            tag = Some(version.tag);
        }
        let body = match self.store.wait(self.store.blocks.get(&key)) {
            Ok(body) => body,
            // not made yet, or the job has just come to its end
            Err(StoreError::NotFound { .. }) => return Ok(false),
            Err(e) => return Err(e.into()),
        };
        self.tag = tag;
        if self.body == body {
            return Ok(false);
        }
        replace::replace(self.file, &body)?;
        self.body = body;
        Ok(true)
    }

    /// Looks now and then. What goes wrong with it is no reason to stop watching.
    fn look(&mut self, uid: &str) {
        if self.looked.is_some_and(|t| t.elapsed() < LOOK_FOR_PREVIEW) {
            return;
        }
        self.looked = Some(Instant::now());
        match self.fetch(uid) {
            Ok(true) => eprintln!("preview {}", self.file.display()),
            Ok(false) => {}
            Err(e) => tracing::warn!("no preview: {e:#}"),
        }
    }
}

/// Key in the storage and file here of each picture of a job that has a name.
fn pictures(job: &RenderJob, namespace: &str, output: &Path) -> Vec<(String, PathBuf)> {
    let name = job.metadata.name.clone().unwrap_or_default();
    let mut here = job.clone();
    here.spec.image.output = Some(output.to_string_lossy().into_owned());
    let extension = kind_of(output).extension();
    let key = |there: PathBuf| job.spec.image.key(namespace, &name, &there.with_extension(extension).to_string_lossy());
    let paths = frames::files(&here).into_iter();
    // a single one is named as it was given
    let paths = paths.map(|path| if path == output { path } else { path.with_extension(extension) });
    frames::files(job).into_iter().map(key).zip(paths).collect()
}

/// Shows each change until the job has come to its end.
fn watch(cluster: &Cluster, name: &str, mut preview: Option<&mut Preview>) -> anyhow::Result<()> {
    let mut said = String::new();
    loop {
        let job = cluster.job(name)?;
        let error = if job.error.is_empty() { String::new() } else { format!(" relMSE {}", job.error) };
        let line = format!("{} {}{error} workers {}", job.phase, job.progress, job.workers);
        if line != said {
            eprintln!("{line}");
            said = line;
        }
        match (job.phase.as_str(), job.why) {
            ("Complete", _) => return Ok(()),
            ("Failed", why) => return Err(Mistake(format!("job {name} failed: {}", why.unwrap_or_default())).into()),
            _ => {
                if let Some(preview) = &mut preview {
                    preview.look(&job.uid);
                }
                std::thread::sleep(LOOK);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rayherd_api::CameraSpec;

    use super::*;

    #[test]
    fn a_preview_follows_the_one_in_the_storage() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("store")).unwrap();
        let store = Store::existing(at("store").to_str().unwrap(), &S3Options::default()).unwrap();
        let file = at("seen.png");
        let mut preview = Preview::new(&store, &file);
        let put = |body: &'static str| store.wait(store.blocks.put("jobs/u-1/preview.png", body.into())).unwrap();
        assert!(!preview.fetch("u-1").unwrap() && !file.exists());
        put("one");
        assert!(preview.fetch("u-1").unwrap() && !preview.fetch("u-1").unwrap());
        put("two");
        assert!(!preview.fetch("u-2").unwrap(), "another job's");
        assert!(preview.fetch("u-1").unwrap());
        assert_eq!(std::fs::read(&file).unwrap(), b"two");
        // the job is over: what was seen last stays here
        store.wait(store.blocks.delete(&["jobs/u-1/preview.png".to_owned()])).unwrap();
        assert!(!preview.fetch("u-1").unwrap() && file.exists());
        for (path, output, part) in [
            (at("a.jpg"), None, "ends in .png"),
            (at("none/a.png"), None, "cannot write"),
            (at("seen.png"), Some(at("seen.png")), "two results"),
        ] {
            let error = check_preview(&path, output.as_ref()).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn pictures_are_where_the_operator_puts_them_and_go_where_render_would() {
        let mut job = RenderJob::new(RenderJobSpec::default());
        job.metadata.name = Some("box".into());
        let pictures = |job: &RenderJob, output: &str| -> Vec<(String, String)> {
            let found = pictures(job, "studio", Path::new(output)).into_iter();
            found.map(|(key, path)| (key, path.to_string_lossy().into_owned())).collect()
        };
        let pair = |key: &str, path: &str| (key.to_owned(), path.to_owned());
        assert_eq!(pictures(&job, "a/b.exr"), [pair("output/studio/box/box.exr", "a/b.exr")]);
        job.spec.image.output = Some("film/part.exr".into());
        let camera = |name: Option<&str>| CameraSpec {
            name: name.map(Into::into),
            origin: [0.0; 3],
            target: [0.0, 0.0, 1.0],
            up: [0.0, 1.0, 0.0],
            fov: 40.0,
        };
        job.spec.image.cameras = vec![camera(Some("left")), camera(None)];
        assert_eq!(
            pictures(&job, "a/b.exr"),
            [
                pair("output/studio/box/film/part-left.exr", "a/b-left.exr"),
                pair("output/studio/box/film/part-0002.exr", "a/b-0002.exr"),
            ]
        );
        job.spec.image.prefix = Some("shots".into());
        assert_eq!(pictures(&job, "a/b.exr")[0], pair("shots/film/part-left.exr", "a/b-left.exr"));
        job.spec.image.prefix = None;
        // the PNG, where the name asks for it
        let of_png = pictures(&job, "b.png");
        assert_eq!(of_png[0], pair("output/studio/box/film/part-left.png", "b-left.png"));
        check_written(&job, Path::new("b.png")).unwrap();
        job.spec.image.files = Some(vec![PictureFile::Exr]);
        check_written(&job, Path::new("b")).unwrap();
        let error = check_written(&job, Path::new("b.png")).unwrap_err().to_string();
        assert!(error.contains("b.png") && error.contains("--files"), "{error}");
    }
}
