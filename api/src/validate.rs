//! What a schema alone can't say, and the ranges again for those who parse without one.

use std::fmt;

use crate::{API_VERSION, ImageSpec, KIND, RenderJob};

/// Something wrong with a job, and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Path of the field, such as `spec.sampling.spp`.
    pub field: String,
    /// What is wrong and the remedy.
    pub message: String,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.field, self.message)
    }
}

/// Every problem of a job, in the order of its fields; none when it can run.
pub fn validate(job: &RenderJob) -> Vec<Problem> {
    let mut c = Checks(Vec::new());
    let spec = &job.spec;
    c.check("apiVersion", job.api_version == API_VERSION, || {
        format!("is {:?}, but this version of rayherd reads {API_VERSION}", job.api_version)
    });
    c.check("kind", job.kind == KIND, || format!("is {:?}, but must be {KIND}", job.kind));

    let scene = &spec.scene;
    match &scene.prepared {
        None => c.check("spec.scene.source", !scene.source.trim().is_empty(), || {
            "is empty: name a scene file or folder".into()
        }),
        Some(hash) => {
            let is_hash = hash.len() == 64 && hash.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
            c.check("spec.scene.prepared", is_hash, || {
                format!("is {hash:?}: give the 64 hexadecimal digits that status.scene of an earlier job says")
            });
            c.check("spec.scene.prepared", scene.source.is_empty(), || {
                "is given together with spec.scene.source: keep one of them".into()
            });
            let imported = scene.iso.is_some()
                || scene.sky.is_some()
                || scene.albedo.is_some()
                || scene.substitute
                || !(scene.lights.is_empty() && scene.define.is_empty());
            c.check("spec.scene.prepared", !imported, || {
                "is imported already: leave out iso, lights, sky, albedo, define and substitute".into()
            });
            c.check("spec.scene.prepared", spec.block_size.is_none() && spec.splits.is_none(), || {
                "is cut already: leave out spec.blockSize and spec.splits".into()
            });
        }
    }
    if let Some(iso) = scene.iso {
        c.check("spec.scene.iso", iso.is_finite(), || format!("is {iso}: give a finite value"));
    }
    for (i, light) in scene.lights.iter().enumerate() {
        let field = |name: &str| format!("spec.scene.lights[{i}].{name}");
        c.finite(&field("origin"), &light.origin);
        c.finite(&field("target"), &light.target);
        c.check(&field("target"), light.target != light.origin, || {
            "is the light's origin: choose a point that its front looks at".into()
        });
        c.check(&field("size"), light.size.iter().all(|x| x.is_finite() && *x > 0.0), || {
            format!("is {:?}: give a width and a height above 0", light.size)
        });
        c.colour(&field("radiance"), &light.radiance, f64::from(f32::MAX));
    }
    if let Some(sky) = &scene.sky {
        c.colour("spec.scene.sky", sky, f64::from(f32::MAX));
    }
    if let Some(albedo) = &scene.albedo {
        c.colour("spec.scene.albedo", albedo, 1.0);
    }

    check_image(&mut c, job);
    let sampling = &spec.sampling;
    let integer = |v: Option<i32>| v.map(f64::from);
    c.range("spec.sampling.spp", integer(sampling.spp), 1.0, f64::from(1 << 24));
    if let Some(error) = sampling.target_error {
        c.check("spec.sampling.targetError", error.is_finite() && error > 0.0, || {
            format!("is {error}: give a relative squared error above 0, such as 0.01")
        });
    }
    if let Some(seconds) = sampling.time_limit {
        c.check("spec.sampling.timeLimit", seconds.is_finite() && seconds > 0.0, || {
            format!("is {seconds}: give seconds above 0")
        });
    }
    c.range("spec.sampling.maxDepth", integer(sampling.max_depth), 1.0, 65535.0);
    c.range("spec.sampling.rrDepth", integer(sampling.rr_depth), 1.0, 65535.0);
    c.range("spec.sampling.split", integer(sampling.split), 1.0, 512.0);
    if let Some(seed) = sampling.seed {
        c.check("spec.sampling.seed", seed >= 0, || format!("is {seed}: give 0 or more"));
    }

    c.check("spec.blockSize", !(spec.block_size.is_some() && spec.splits.is_some()), || {
        "is given together with spec.splits: keep one of them".into()
    });
    c.check("spec.blockSize", spec.block_size.is_none_or(|b| b.bytes() > 0), || {
        "is 0: give a size such as 64Mi".into()
    });
    c.range("spec.splits", spec.splits.map(|n| n as f64), 1.0, 1e6);
    c.range("spec.overlapThreshold", spec.overlap_threshold, 0.0, 1.0);
    check_workers(&mut c, job);
    c.range("spec.taskSeconds", spec.task_seconds, 0.01, 3600.0);
    c.check("spec.activeDeadlineSeconds", spec.active_deadline_seconds.is_none_or(|s| s > 0), || {
        "must be above 0: leave it out for a job without a deadline".into()
    });
    c.check("spec.ttlSecondsAfterFinished", spec.ttl_seconds_after_finished.is_none_or(|s| s >= 0), || {
        "must be 0 or more: leave it out for a job that stays".into()
    });
    c.0
}

fn check_image(c: &mut Checks, job: &RenderJob) {
    let image = &job.spec.image;
    for (i, camera) in image.cameras.iter().enumerate() {
        let field = |name: &str| format!("spec.image.cameras[{i}].{name}");
        if let Some(name) = &camera.name {
            let allowed = |b: u8| b.is_ascii_alphanumeric() || b"._-".contains(&b);
            c.check(&field("name"), !name.is_empty() && name.bytes().all(allowed), || {
                format!("is {name:?}: use letters, digits, '.', '_' and '-'")
            });
            let first = image.cameras[..i].iter().position(|other| other.name.as_ref() == Some(name));
            c.check(&field("name"), first.is_none(), || {
                format!("is {name:?} like that of cameras[{}]: give each its own", first.unwrap_or(0))
            });
        }
        let vectors = [("origin", camera.origin), ("target", camera.target), ("up", camera.up)];
        for (name, v) in vectors {
            c.finite(&field(name), &v);
        }
        let view: [f64; 3] = std::array::from_fn(|k| camera.target[k] - camera.origin[k]);
        c.check(&field("target"), view.iter().any(|&x| x != 0.0), || {
            "is the camera's origin: choose a point that it looks at".into()
        });
        let cross: [f64; 3] = std::array::from_fn(|k| {
            let (a, b) = ((k + 1) % 3, (k + 2) % 3);
            view[a] * camera.up[b] - view[b] * camera.up[a]
        });
        c.check(&field("up"), cross.iter().any(|&x| x != 0.0), || {
            "is zero or along the view: choose another direction".into()
        });
        c.range(&field("fov"), Some(camera.fov), 0.001, 179.0);
    }
    if let Some(output) = &image.output {
        c.check("spec.image.output", output.ends_with(".exr") && output.len() > 4, || {
            format!("is {output:?}: name a file that ends in .exr (the PNG stands beside it)")
        });
    }
    if let Some(prefix) = &image.prefix {
        let mut parts = prefix.split('/');
        let relative = parts.clone().all(|p| !p.is_empty() && !p.starts_with('.'));
        let taken = parts.next().is_some_and(|p| ImageSpec::TAKEN.contains(&p));
        c.check("spec.image.prefix", relative && !taken, || {
            let own = ImageSpec::TAKEN.join(", ");
            format!("is {prefix:?}: give a relative path such as shots/room, and none in Rayherd's own folders: {own}")
        });
    }
    if let Some(files) = &image.files {
        c.check("spec.image.files", !files.is_empty(), || "is empty: name Exr, Png or both".into());
        let twice = (1..files.len()).any(|i| files[..i].contains(&files[i]));
        c.check("spec.image.files", !twice, || "names a file twice: name each once".into());
    }
    c.range("spec.image.exposure", image.exposure, -32.0, 32.0);
}

fn check_workers(c: &mut Checks, job: &RenderJob) {
    let workers = &job.spec.workers;
    c.range("spec.workers.nodes", workers.nodes.map(f64::from), 1.0, 4096.0);
    c.range("spec.workers.min", workers.min.map(f64::from), 1.0, 4096.0);
    c.range("spec.workers.max", workers.max.map(f64::from), 1.0, 4096.0);
    c.check("spec.workers.min", workers.min.is_some() == workers.max.is_some() && workers.min <= workers.max, || {
        "and spec.workers.max are given together, the first at most the second".into()
    });
    c.check("spec.workers.nodes", workers.nodes.is_none() || workers.max.is_none(), || {
        "is given together with spec.workers.max: keep one of them".into()
    });
    c.check("spec.workers.slots", workers.max.is_none() || workers.slots.len() < 2, || {
        "has several numbers, but with spec.workers.max there is one for all".into()
    });
    for (i, &slots) in workers.slots.iter().enumerate() {
        c.range(&format!("spec.workers.slots[{i}]"), Some(f64::from(slots)), 1.0, 1024.0);
    }
    let nodes = workers.nodes.unwrap_or(1).max(1);
    let fits = workers.slots.len() < 2 || workers.nodes.is_none_or(|n| n as usize == workers.slots.len());
    c.check("spec.workers.slots", fits, || {
        format!("has {} numbers for {nodes} nodes: give one for all, or one for each", workers.slots.len())
    });
    c.check("spec.workers.memory", workers.memory.is_none_or(|m| m.bytes() > 0), || {
        "is 0: give the memory of one node, such as 4Gi".into()
    });
    c.range("spec.workers.keepWarmSeconds", workers.keep_warm_seconds.map(|s| s as f64), 0.0, 86400.0);
    c.check("spec.workers.template", workers.template.as_ref().is_none_or(serde_json::Value::is_object), || {
        "is no object: give a PodTemplateSpec, with metadata and spec".into()
    });
    // one that is misspelt would change nothing, and nobody would say so
    for name in workers.template.iter().filter_map(serde_json::Value::as_object).flat_map(|t| t.keys()) {
        let known = matches!(name.as_str(), "apiVersion" | "kind" | "metadata" | "spec");
        c.check(&format!("spec.workers.template.{name}"), known, || {
            "is no part of a PodTemplateSpec: give metadata and spec".into()
        });
    }
    c.range("spec.replicas", job.spec.replicas.map(f64::from), 1.0, 16.0);
}

/// Virtual nodes of a job that runs in one process.
pub fn local_nodes(job: &RenderJob) -> usize {
    let workers = &job.spec.workers;
    workers.nodes.or(workers.max).map_or(workers.slots.len().max(1), |n| n.max(1) as usize)
}

/// What else is wrong with a job that runs in one process, whose virtual nodes are its stores as well. On a cluster these are servers, of
/// which there may be more than workers.
pub fn validate_local(job: &RenderJob) -> Vec<Problem> {
    let mut c = Checks(Vec::new());
    let nodes = local_nodes(job);
    if let Some(replicas) = job.spec.replicas {
        c.check("spec.replicas", replicas < 1 || replicas as usize <= nodes, || {
            format!("is {replicas}, but there are {nodes} nodes: ask for at most one copy per node")
        });
    }
    c.0
}

struct Checks(Vec<Problem>);

impl Checks {
    fn check(&mut self, field: &str, ok: bool, message: impl FnOnce() -> String) {
        if !ok {
            self.0.push(Problem { field: field.to_owned(), message: message() });
        }
    }
    fn finite(&mut self, field: &str, numbers: &[f64]) {
        self.check(field, numbers.iter().all(|x| x.is_finite()), || format!("is {numbers:?}: give finite numbers"));
    }
    /// One number or three, 0 to `most`.
    fn colour(&mut self, field: &str, colour: &[f64], most: f64) {
        self.check(field, matches!(colour.len(), 1 | 3), || {
            format!("has {} numbers: give one, or three for red, green and blue", colour.len())
        });
        self.check(field, colour.iter().all(|v| (0.0..=most).contains(v)), || {
            format!("is {colour:?}: give numbers from 0 to {most}")
        });
    }
    fn range(&mut self, field: &str, value: Option<f64>, lo: f64, hi: f64) {
        if let Some(value) = value {
            self.check(field, (lo..=hi).contains(&value), || format!("is {value}: give {lo} to {hi}"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ByteSize, PictureFile, Strategy};

    const FULL: &str = "
apiVersion: rayherd.io/v1alpha1
kind: RenderJob
metadata:
  name: chest
  labels: {team: herd}
  uid: left-alone
spec:
  scene: {source: chest, iso: -789.5, albedo: [0.7], sky: [0.1, 0.2, 0.3], define: {spp: '4'}, lights: [{origin: [0, 5, 0], target: [0, 0, 0], size: [1, 1], radiance: [10]}]}
  image:
    size: 256x256
    cameras:
    - {name: front, origin: [0, 0, 5], target: [0, 0, 0], fov: 40}
    - {origin: [0, 0, -5], target: [0, 0, 0], up: [1, 0, 0], fov: 40}
    output: chest.exr
    exposure: -1.5
    files: [Exr, Png]
  sampling: {spp: 64, targetError: 0.01, maxDepth: 8, rrDepth: 5, split: 4, seed: 7}
  strategy: SchedulingGridOverlapReduced
  splits: 32
  overlapThreshold: 0.2
  workers: {nodes: 4, slots: [2, 2, 4, 4], memory: 512Mi}
  replicas: 2
  barrier: true
  taskSeconds: 10
";

    fn parse(text: &str) -> Result<RenderJob, serde_yaml::Error> {
        serde_yaml::from_str(text)
    }

    #[test]
    fn a_full_job_is_valid_and_survives_a_round_trip() {
        let job = parse(FULL).unwrap();
        assert_eq!(validate(&job), []);
        assert_eq!(job.spec.workers.slots_per_node(1), Some(vec![2, 2, 4, 4]));
        assert_eq!(job.spec.workers.memory.unwrap().bytes(), 512 << 20);
        assert_eq!(parse(&serde_yaml::to_string(&job).unwrap()).unwrap(), job);
    }

    #[test]
    fn the_least_job_is_valid() {
        let text = "{apiVersion: rayherd.io/v1alpha1, kind: RenderJob, spec: {scene: {source: a.ply}}}";
        let job = parse(text).unwrap();
        assert_eq!(validate(&job), []);
        assert_eq!(job.spec.strategy, Strategy::Auto);
        assert_eq!(job.spec.workers.slots_per_node(3), Some(vec![3]));
    }

    #[test]
    fn unknown_and_missing_fields_are_named_with_their_place() {
        for (from, to, parts) in [
            ("    size:", "    sise:", ["unknown field `sise`", "`size`"]),
            ("  replicas: 2", "  replica: 2", ["unknown field `replica`", "`replicas`"]),
            ("size: 256x256", "size: 256", ["spec.image", "WIDTHxHEIGHT"]),
            ("size: 256x256", "size: 0x256", ["spec.image", "line 11"]),
            ("memory: 512Mi", "memory: 512K", ["spec.workers", "ambiguous"]),
            ("fov: 40}", "}", ["missing field `fov`", "cameras[0]"]),
            ("GridOverlapReduced", "Grid2", ["unknown variant `SchedulingGrid2`", "`DemandDriven`"]),
        ] {
            let error = parse(&FULL.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(parts.iter().all(|p| error.contains(p)), "{from} -> {to}: {error}");
        }
    }

    #[test]
    fn a_prepared_scene_and_bounds_of_workers_stand_in_for_others() {
        let mut job = parse(FULL).unwrap();
        job.spec.scene = crate::SceneSpec { prepared: Some("0".repeat(64)), ..Default::default() };
        (job.spec.splits, job.spec.workers.nodes, job.spec.workers.slots) = (None, None, vec![2]);
        (job.spec.workers.min, job.spec.workers.max) = (Some(2), Some(3));
        assert_eq!(validate(&job), []);
        assert_eq!(job.spec.workers.slots_per_node(1), Some(vec![2; 3]));
        job.spec.scene.source = "a.xml".into();
        job.spec.scene.iso = Some(1.0);
        job.spec.splits = Some(2);
        job.spec.workers.min = Some(4);
        job.spec.workers.nodes = Some(3);
        let fields: Vec<String> = validate(&job).into_iter().map(|p| p.field).collect();
        assert_eq!(fields[..3], ["spec.scene.prepared"; 3]);
        assert_eq!(fields[3..], ["spec.workers.min", "spec.workers.nodes"]);
        job.spec.scene.prepared = Some("G".into());
        assert!(validate(&job)[0].message.contains("64 hexadecimal digits"));
    }

    #[test]
    fn every_problem_is_listed_with_its_field() {
        let mut job = parse(FULL).unwrap();
        job.api_version = "v1".into();
        job.kind = "Job".into();
        let spec = &mut job.spec;
        spec.scene.source = " ".into();
        spec.scene.iso = Some(f64::NAN);
        spec.scene.sky = Some(vec![1.0, 2.0]);
        spec.scene.albedo = Some(vec![1.5]);
        spec.scene.lights[0].target = spec.scene.lights[0].origin;
        spec.scene.lights[0].size = [1.0, 0.0];
        spec.scene.lights[0].radiance = vec![];
        spec.image.cameras[0].target = spec.image.cameras[0].origin;
        spec.image.cameras[1].up = [0.0, 0.0, 1.0];
        spec.image.cameras[1].fov = 180.0;
        spec.image.cameras[1].name = Some("front".into());
        spec.image.output = Some("a.png".into());
        spec.image.prefix = Some("jobs/u-1".into());
        spec.image.files = Some(vec![PictureFile::Png; 2]);
        spec.image.exposure = Some(f64::INFINITY);
        spec.sampling.spp = Some(1 << 25);
        spec.sampling.target_error = Some(0.0);
        spec.sampling.time_limit = Some(f64::NAN);
        spec.sampling.max_depth = Some(0);
        spec.sampling.split = Some(-1);
        spec.sampling.seed = Some(-7);
        spec.block_size = Some(ByteSize::new(0));
        spec.overlap_threshold = Some(1.1);
        spec.workers.nodes = Some(3);
        spec.workers.memory = Some(ByteSize::new(0));
        spec.workers.template = Some(serde_json::json!({"spce": {}, "spec": {}}));
        spec.replicas = Some(17);
        spec.task_seconds = Some(0.0);
        spec.active_deadline_seconds = Some(0);
        spec.ttl_seconds_after_finished = Some(-1);
        let fields: Vec<String> = validate(&job).into_iter().map(|p| p.field).collect();
        let want = [
            "apiVersion",
            "kind",
            "spec.scene.source",
            "spec.scene.iso",
            "spec.scene.lights[0].target",
            "spec.scene.lights[0].size",
            "spec.scene.lights[0].radiance",
            "spec.scene.sky",
            "spec.scene.albedo",
            "spec.image.cameras[0].target",
            "spec.image.cameras[0].up",
            "spec.image.cameras[1].name",
            "spec.image.cameras[1].up",
            "spec.image.cameras[1].fov",
            "spec.image.output",
            "spec.image.prefix",
            "spec.image.files",
            "spec.image.exposure",
            "spec.sampling.spp",
            "spec.sampling.targetError",
            "spec.sampling.timeLimit",
            "spec.sampling.maxDepth",
            "spec.sampling.split",
            "spec.sampling.seed",
            "spec.blockSize",
            "spec.blockSize",
            "spec.overlapThreshold",
            "spec.workers.slots",
            "spec.workers.memory",
            "spec.workers.template.spce",
            "spec.replicas",
            "spec.taskSeconds",
            "spec.activeDeadlineSeconds",
            "spec.ttlSecondsAfterFinished",
        ];
        assert_eq!(fields, want);
    }

    #[test]
    fn a_cluster_may_have_more_servers_than_a_job_has_workers() {
        let mut job = parse(FULL).unwrap();
        job.spec.workers = crate::WorkersSpec { nodes: Some(1), ..Default::default() };
        assert_eq!(validate(&job), []);
        assert_eq!(validate_local(&job)[0].field, "spec.replicas");
        job.spec.replicas = Some(1);
        assert_eq!(validate_local(&job), []);
    }

    /// Kubernetes' structural schemas have int32, int64 and no unsigned formats.
    #[test]
    fn the_schema_has_no_unsigned_formats() {
        let schema = serde_json::to_string(&schemars::schema_for!(RenderJob)).unwrap();
        assert!(schema.contains("\"int32\"") && schema.contains("overlapThreshold"), "{schema}");
        assert!(!schema.contains("uint"), "{schema}");
    }
}
