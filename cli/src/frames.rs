//! The frames of a job: which camera, which file.

use std::path::{Path, PathBuf};

use rayherd_api::{CameraSpec, ImageSpec, PictureFile, RenderJob};
use rayherd_herd::job::spec;
use rayherd_render::film::Layout;
use rayherd_render::frame::Frame;
use rayherd_scene::manifest::Manifest;

use crate::fault::Mistake;
use crate::source;

/// One picture of a job.
pub struct Shot {
    /// What defines it besides the scene.
    pub frame: Frame,
    /// Where it goes; the PNG stands beside it.
    pub exr: PathBuf,
}

impl Shot {
    /// The PNG beside the EXR.
    pub fn png(&self) -> PathBuf {
        self.exr.with_extension("png")
    }
    /// Those of its files that are written.
    pub fn written(&self, image: &ImageSpec) -> Vec<PathBuf> {
        written(&self.exr, image)
    }
}

/// The shots of a job that was checked, in its order.
pub fn shots(job: &RenderJob, manifest: &Manifest) -> anyhow::Result<Vec<Shot>> {
    let files = files(job);
    let cameras = &job.spec.image.cameras;
    if cameras.is_empty() {
        return Ok(vec![Shot { frame: frame(job, manifest, None)?, exr: files[0].clone() }]);
    }
    cameras.iter().zip(files).map(|(c, exr)| Ok(Shot { frame: frame(job, manifest, Some(c))?, exr })).collect()
}

/// Where the pictures go, known before the scene is read: one for each camera, one when there is none.
pub fn files(job: &RenderJob) -> Vec<PathBuf> {
    let name = || job.metadata.name.clone().unwrap_or_else(|| source::name(&job.spec.scene.source));
    let output = job.spec.image.output.as_ref().map_or_else(|| PathBuf::from(format!("{}.exr", name())), PathBuf::from);
    let cameras = &job.spec.image.cameras;
    if cameras.len() < 2 {
        return vec![output];
    }
    let stem = output.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let numbered = |(i, c): (usize, &CameraSpec)| {
        let mark = c.name.clone().unwrap_or_else(|| format!("{:04}", i + 1));
        output.with_file_name(format!("{stem}-{mark}.exr"))
    };
    cameras.iter().enumerate().map(numbered).collect()
}

/// Those of the files of the picture with this EXR that are written.
pub fn written(exr: &Path, image: &ImageSpec) -> Vec<PathBuf> {
    let wanted = PictureFile::ALL.into_iter().filter(|&file| image.writes(file));
    let path = |file| match file {
        // as it was named
        PictureFile::Exr => exr.to_owned(),
        PictureFile::Png => exr.with_extension("png"),
    };
    wanted.map(path).collect()
}

/// Whether each picture has a file of its own: a camera's name may be another's number.
pub fn check_files(files: &[PathBuf]) -> Result<(), Mistake> {
    match (1..files.len()).find(|&i| files[..i].contains(&files[i])) {
        Some(i) => {
            Err(Mistake(format!("two cameras would write {}: give camera {} another name", files[i].display(), i + 1)))
        }
        None => Ok(()),
    }
}

/// The frame that a camera sees; the scene's own without one.
pub fn frame(job: &RenderJob, manifest: &Manifest, camera: Option<&CameraSpec>) -> anyhow::Result<Frame> {
    let frame = spec::frame(&job.spec, manifest, camera)?;
    check_memory(frame.layout())?;
    Ok(frame)
}

/// Bytes per pixel: the film's two halves of three 16-byte sums, once for the whole and once in tasks, and the picture.
const BYTES_PER_PIXEL: u64 = 2 * 96 + 12;

fn check_memory(layout: impl Into<Layout>) -> Result<(), Mistake> {
    let Layout { size: [width, height], aovs } = layout.into();
    // their sums likewise, and their channels
    let of_aovs = aovs.iter().map(|a| 2 * 16 * a.sums() + 4 * a.channels().len()).sum::<usize>() as u64;
    let needed = u64::from(width) * u64::from(height) * (BYTES_PER_PIXEL + of_aovs);
    let Some(have) = memory_of_machine() else { return Ok(()) };
    if needed > have {
        let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
        let message = "give a smaller --size, or several --camera with a smaller FOV, each with a picture of its own";
        return Err(Mistake(format!(
            "an image of {width}x{height} pixels takes {:.1} GiB, this machine has {:.1}: {message}",
            gib(needed),
            gib(have)
        )));
    }
    Ok(())
}

/// Bytes of memory, where the system tells.
pub fn memory_of_machine() -> Option<u64> {
    let text = std::fs::read_to_string(Path::new("/proc/meminfo")).ok()?;
    let line = text.lines().find(|l| l.starts_with("MemTotal:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kib| kib * 1024)
}

#[cfg(test)]
mod tests {
    use rayherd_api::RenderJobSpec;

    use super::*;

    fn camera(name: Option<&str>) -> CameraSpec {
        CameraSpec {
            name: name.map(str::to_owned),
            origin: [0.0, 0.0, 4.0],
            target: [0.0; 3],
            up: [0.0, 1.0, 0.0],
            fov: 40.0,
        }
    }

    #[test]
    fn every_camera_has_its_file() {
        let mut spec = RenderJobSpec::default();
        spec.scene.source = "scenes/room.xml".into();
        let mut job = RenderJob::new(spec);
        assert_eq!(files(&job), [PathBuf::from("room.exr")]);
        job.metadata.name = Some("night".into());
        assert_eq!(files(&job), [PathBuf::from("night.exr")]);
        job.spec.image.output = Some("out/x.exr".into());
        job.spec.image.cameras = vec![camera(Some("front"))];
        assert_eq!(files(&job), [PathBuf::from("out/x.exr")]);
        job.spec.image.cameras.push(camera(None));
        assert_eq!(files(&job), [PathBuf::from("out/x-front.exr"), PathBuf::from("out/x-0002.exr")]);
        check_files(&files(&job)).unwrap();
        job.spec.image.cameras[0].name = Some("0002".into());
        assert!(check_files(&files(&job)).unwrap_err().to_string().contains("x-0002.exr"));
    }

    #[test]
    fn an_image_that_does_not_fit_is_refused() {
        if memory_of_machine().is_none_or(|have| have > 800 << 30) {
            eprintln!("this system does not say how much memory it has, or has a lot");
            return;
        }
        assert!(check_memory([65535, 65535]).unwrap_err().to_string().contains("GiB"));
        assert!(check_memory([64, 64]).is_ok());
    }
}
