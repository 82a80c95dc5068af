//! `rayherd render` from outside.

mod common;

use std::fs;
use std::path::Path;

use common::{Run, assert_mistake, rayherd, repository};
use rayherd_herd::profile::Part;
use rayherd_render::bvh::{Kernel, Tracer};
use serde_json::Value;

fn cornell(folder: &Path, output: &str, more: &[&str]) -> Run {
    let scene = repository("examples/cornell-box.xml");
    let mut arguments = vec!["render", scene.to_str().unwrap(), "--size", "16x16", "--spp", "4", "-o", output];
    arguments.extend(more);
    rayherd(folder, &arguments)
}

fn files(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn the_files_are_the_same_however_it_runs() {
    let folder = tempfile::tempdir().unwrap();
    let run = |name: &str, more: &[&str]| {
        let run = cornell(folder.path(), name, more);
        assert_eq!(run.code, 0, "{more:?}: {}", run.err);
        fs::read(folder.path().join(name)).unwrap()
    };
    let first = run("a.exr", &["--threads", "1", "--report", "r.json"]);
    for more in [
        &["--threads", "2"][..],
        &["--kernel", "scalar", "--threads", "1"],
        &["--splits", "3", "--kernel", "auto", "--strategy", "scheduling-grid"],
        &["--splits", "5", "--strategy", "demand-driven", "--nodes", "2", "--slots", "1", "--replicas", "2"],
        &["--splits", "3", "--strategy", "scheduling-grid", "--slots", "1,2", "--barrier", "off"],
        &["--block-size", "1Ki", "--strategy", "scheduling-grid-overlap-reduced", "--memory", "4KiB"],
        &["--splits", "4", "--nodes", "3", "--memory", "2Ki", "--task-seconds", "0.01"],
    ] {
        assert!(run("b.exr", more) == first, "{more:?}");
    }
    // the machine's kernels, where every ray stays in its task and where rays travel
    for (name, kernel) in [("scalar", Kernel::Scalar), ("avx2", Kernel::Avx2), ("avx512", Kernel::Avx512)] {
        if Tracer::new(kernel).is_err() {
            println!("this machine has no {name}: not compared");
            continue;
        }
        let travel =
            ["--kernel", name, "--splits", "3", "--strategy", "scheduling-grid-overlap-reduced", "--nodes", "2"];
        for more in [&["--kernel", name][..], &travel] {
            assert!(run("b.exr", more) == first, "{more:?}");
        }
    }
    // another image is another file: the header says which
    assert!(run("c.exr", &["--seed", "1"]) != first);
    let equal = rayherd(folder.path(), &["compare", "a.exr", "b.exr"]);
    assert_eq!(equal.code, 0, "{}", equal.out);
    let other = rayherd(folder.path(), &["compare", "a.exr", "c.exr"]);
    assert_eq!(other.code, 1, "{}", other.out);
    // nothing but pictures and report is left
    assert_eq!(files(folder.path()), ["a.exr", "a.png", "b.exr", "b.png", "c.exr", "c.png", "r.json"]);

    let report: Value = serde_json::from_slice(&fs::read(folder.path().join("r.json")).unwrap()).unwrap();
    // the documentation lists these keys and no others
    let text = fs::read_to_string(repository("docs/report.md")).unwrap();
    let cells = text.lines().filter(|l| l.starts_with("| `")).map(|l| l.split(" | ").next().unwrap());
    let mut documented: Vec<&str> = cells.flat_map(|c| c.split('`').skip(1).step_by(2)).collect();
    documented.sort_unstable();
    let mut keys: Vec<&String> = report.as_object().unwrap().keys().collect();
    keys.sort_unstable();
    assert_eq!(keys, documented);
    assert_nested_keys(&report, &text);
    let moved = |stage: &str, kind: &str| {
        let rows = report["bytes"].as_array().unwrap().iter();
        rows.filter(|r| r["stage"] == stage && r["kind"] == kind).map(|r| r["bytes"].as_u64().unwrap()).sum::<u64>()
    };
    let source = fs::metadata(repository("examples/cornell-box.xml")).unwrap().len();
    assert!(moved("prepare", "source") >= source, "{} {source}", moved("prepare", "source"));
    assert!(moved("prepare", "geometry") > 0 && moved("prepare", "manifest") > 0);
    assert_eq!(report["samples"], 16 * 16 * 4);
    assert_eq!(report["prepare"]["counts"]["triangles"], 36);
}

/// Keys inside of keys: those that are here and no others, each named in its key's row.
#[track_caller]
fn assert_nested_keys(report: &Value, documentation: &str) {
    for (place, expected) in [
        ("rays", &["camera", "closest", "merged", "shadow"][..]),
        ("bytes", &["bytes", "kind", "op", "place", "stage"]),
        ("nodes_detail", &["busy", "peak_scene_bytes", "peak_texture_bytes", "reads", "remote_reads", "slots"]),
        ("skipped", &["degenerate", "non_finite", "out_of_range"]),
        (
            "prepare",
            &[
                "choice",
                "contested_share",
                "copied_splits",
                "counts",
                "reused",
                "scene",
                "splits",
                "subdiv",
                "substitutions",
                "took",
            ],
        ),
    ] {
        let row = documentation.lines().find(|l| l.starts_with(&format!("| `{place}`"))).unwrap();
        let values = report[place].as_array().map_or(vec![&report[place]], |rows| rows.iter().collect());
        assert!(!values.is_empty(), "{place}");
        for value in values {
            let mut keys: Vec<&String> = value.as_object().unwrap().keys().collect();
            keys.sort_unstable();
            assert_eq!(keys, expected, "{place}");
        }
        for key in expected {
            assert!(row.contains(&format!("`{key}`")), "{key} of {place} is not in {row}");
        }
    }
}

/// `--profile` changes no byte; the report has what each stage took, and so does a table at the end.
#[test]
fn a_profile_says_what_each_stage_takes() {
    let folder = tempfile::tempdir().unwrap();
    let plain = cornell(folder.path(), "a.exr", &["--report", "a.json"]);
    let measured = cornell(folder.path(), "b.exr", &["--report", "b.json", "--profile"]);
    assert_eq!((plain.code, measured.code), (0, 0), "{}{}", plain.err, measured.err);
    let read = |name: &str| fs::read(folder.path().join(name)).unwrap();
    assert!(read("a.exr") == read("b.exr"));
    let [a, b]: [Value; 2] = ["a.json", "b.json"].map(|name| serde_json::from_slice(&read(name)).unwrap());
    assert!(a["profile"].is_null(), "{}", a["profile"]);
    let profile = b["profile"].as_object().unwrap();
    let text = fs::read_to_string(repository("docs/report.md")).unwrap();
    let row = text.lines().find(|l| l.starts_with("| `profile`")).unwrap();
    for part in Part::ALL {
        let cost = &profile[part.name()];
        assert!(cost["cpu_s"].is_f64() && cost["items"].is_u64(), "{}: {cost}", part.name());
        assert!(row.contains(&format!("`{}`", part.name())), "{} is not in {row}", part.name());
        // the table leaves out what there was nothing of
        let told = measured.out.lines().any(|l| l.starts_with(&format!("{} ", part.name())));
        assert_eq!(told, cost["items"] != 0, "{}: {}", part.name(), measured.out);
        assert!(!plain.out.lines().any(|l| l.starts_with(&format!("{} ", part.name()))), "{}", plain.out);
    }
    assert_eq!(profile.len(), Part::ALL.len());
    // in one task every ray is made, traced and shaded once
    let rays = &b["rays"];
    for (part, count) in [("camera", "camera"), ("closest", "closest"), ("shading", "closest"), ("shadow", "shadow")] {
        assert_eq!(profile[part]["items"], rays[count], "{part}");
    }
}

/// A stand-in is told in the log, with its place, and in the report.
#[test]
fn stand_ins_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let text = "<scene version='3.0.0'>\n<shape type='rectangle'>\n<bsdf type='ward'/></shape>\n<emitter type='constant'/></scene>";
    fs::write(folder.path().join("s.xml"), text).unwrap();
    let render = ["render", "s.xml", "--size", "8x8", "--spp", "1", "--report", "r.json"];
    assert_mistake(&rayherd(folder.path(), &render), &["s.xml:3:1: bsdf \"ward\"", "--substitute"]);
    assert!(!folder.path().join("s.exr").exists() && !folder.path().join("r.json").exists());
    let run = rayherd(folder.path(), &[&render[..], &["--substitute"]].concat());
    assert_eq!(run.code, 0, "{}", run.err);
    let warning = "s.xml:3:1: bsdf \"ward\" is not supported; in its place: ";
    let stand_in = run.err.lines().find_map(|l| l.split_once(warning)).unwrap_or_else(|| panic!("{}", run.err)).1;
    assert!(stand_in.contains("diffuse"), "{stand_in}");
    let report: Value = serde_json::from_slice(&fs::read(folder.path().join("r.json")).unwrap()).unwrap();
    let told = report["prepare"]["substitutions"].as_array().unwrap();
    assert_eq!(told.len(), 1, "{told:?}");
    assert_eq!((&told[0]["what"], &told[0]["stand_in"]), (&"bsdf \"ward\"".into(), &stand_in.into()), "{told:?}");
    assert_eq!(told[0]["place"]["line"], 3, "{told:?}");
}

/// What a job file says of lights, sky and albedo is what the flags say, to the byte; and each of them counts.
#[test]
fn a_job_file_lights_a_mesh_as_the_flags_do() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    fs::write(folder.join("a.obj"), "v -1 0 -1\nv 1 0 -1\nv 1 0 1\nv -1 0.5 1\nf 1 4 3 2\n").unwrap();
    let job = "
apiVersion: rayherd.io/v1alpha1
kind: RenderJob
spec:
  scene:
    source: a.obj
    albedo: [0.8, 0.4, 0.2]
    sky: [0.1, 0.2, 0.3]
    lights:
    - {origin: [0, 3, 0], target: [0, 0, 0], size: [1, 0.5], radiance: [9, 8, 7]}
    - {origin: [2, 2, 0], target: [0, 0, 0], size: [0.5, 0.5], radiance: [4]}
  image: {size: 12x10}
  sampling: {spp: 3}
";
    fs::write(folder.join("job.yaml"), job).unwrap();
    let picture = |arguments: &[&str]| {
        let run = rayherd(folder, &[&["render"], arguments, &["-o", "x.exr"]].concat());
        assert_eq!(run.code, 0, "{arguments:?}: {}", run.err);
        fs::read(folder.join("x.exr")).unwrap()
    };
    let image = ["a.obj", "--size", "12x10", "--spp", "3"];
    let lights = ["--light", "0,3,0,0,0,0,1,0.5,9,8,7", "--light", "2,2,0,0,0,0,0.5,0.5,4"];
    let (sky, albedo) = (["--sky", "0.1,0.2,0.3"], ["--albedo", "0.8,0.4,0.2"]);
    let of_job = picture(&["-f", "job.yaml"]);
    assert!(of_job == picture(&[&image[..], &lights, &sky, &albedo].concat()));
    for parts in [[&lights[..2], &sky, &albedo], [&lights[..], &[], &albedo], [&lights[..], &sky, &[]]] {
        assert!(of_job != picture(&[&image[..], &parts.concat()].concat()), "{parts:?}");
    }
    // and a flag wins over the file
    let flag = picture(&["-f", "job.yaml", "--sky", "0"]);
    assert!(flag == picture(&[&image[..], &lights, &["--sky", "0"], &albedo].concat()) && flag != of_job);
}

#[test]
fn the_summary_says_where_and_how_noisy() {
    let folder = tempfile::tempdir().unwrap();
    let run = cornell(folder.path(), "x.exr", &["--target-error", "1e-9"]);
    assert_eq!(run.code, 0, "{}", run.err);
    let parts = ["x.exr and x.png: 16x16, 4 spp, relMSE ", "(target 0.000000001 not reached", "CPU-seconds"];
    assert!(parts.iter().all(|p| run.out.contains(p)), "{}", run.out);
    let run = cornell(folder.path(), "x.exr", &["--target-error", "1e9"]);
    assert!(run.out.contains("reached)"), "{}", run.out);
}

#[test]
fn a_job_file_renders_a_frame_for_each_camera() {
    let folder = tempfile::tempdir().unwrap();
    fs::copy(repository("examples/cornell-box.xml"), folder.path().join("box.xml")).unwrap();
    fs::create_dir(folder.path().join("jobs")).unwrap();
    let job = "
apiVersion: rayherd.io/v1alpha1
kind: RenderJob
metadata: {name: two}
spec:
  scene: {source: ../box.xml}
  image:
    size: 16x8
    cameras:
    - {name: front, origin: [0, 1, 6.8], target: [0, 1, 0], fov: 20}
    - {origin: [0, 1, 6.8], target: [0, 0.5, 0], fov: 30}
  sampling: {spp: 2, maxDepth: 3}
  strategy: SchedulingGridOverlapReduced
  splits: 3
  workers: {slots: [1, 1], memory: 8Ki}
  replicas: 2
";
    fs::write(folder.path().join("jobs/two.yaml"), job).unwrap();
    let run = rayherd(folder.path(), &["render", "-f", "jobs/two.yaml", "--report", "r.json"]);
    assert_eq!(run.code, 0, "{}", run.err);
    assert_eq!(run.out.lines().count(), 2, "{}", run.out);
    let report: Value = serde_json::from_slice(&fs::read(folder.path().join("r.json")).unwrap()).unwrap();
    assert_eq!(report.as_array().map(Vec::len), Some(2));
    assert_eq!(report[0]["strategy"], "scheduling-grid-overlap-reduced");
    assert_eq!(report[1]["nodes"], 2);
    // the same cameras by flags, over the file
    let flags = ["render", "-f", "jobs/two.yaml", "--camera", "0,1,6.8,0,1,0,0,1,0,20", "-o", "flags.exr"];
    assert_eq!(rayherd(folder.path(), &flags).code, 0);
    let same = rayherd(folder.path(), &["compare", "two-front.exr", "flags.exr"]);
    assert!(same.out.contains("\"file_identical\": true"), "{}", same.out);
    let other = rayherd(folder.path(), &["compare", "two-front.exr", "two-0002.exr"]);
    assert_eq!(other.code, 1, "{}", other.err);

    fs::write(folder.path().join("bad.yaml"), job.replace("maxDepth", "maxdepth")).unwrap();
    assert_mistake(
        &rayherd(folder.path(), &["render", "-f", "bad.yaml"]),
        &["bad.yaml", "unknown field `maxdepth`", "`maxDepth`", "line"],
    );
    fs::write(folder.path().join("bad.yaml"), job.replace("replicas: 2", "replicas: 3").replace("fov: 20", "fov: 0"))
        .unwrap();
    assert_mistake(&rayherd(folder.path(), &["render", "-f", "bad.yaml"]), &["bad.yaml: spec.image.cameras[0].fov"]);
    // a cluster has more servers than the job workers; what is asked for by a flag is meant for here
    fs::write(
        folder.path().join("jobs/more.yaml"),
        job.replace("replicas: 2", "replicas: 3").replace("name: two", "name: more"),
    )
    .unwrap();
    let run = rayherd(folder.path(), &["render", "-f", "jobs/more.yaml"]);
    assert!(run.code == 0 && run.err.contains("one copy on each of 2 node(s)"), "{}", run.err);
    assert_eq!(
        fs::read(folder.path().join("more-front.exr")).unwrap(),
        fs::read(folder.path().join("two-front.exr")).unwrap()
    );
    assert_mistake(
        &rayherd(folder.path(), &["render", "-f", "jobs/more.yaml", "--replicas", "3"]),
        &["--replicas is 3, but there are 2 nodes"],
    );
}

#[test]
fn mistakes_are_found_before_anything_is_rendered() {
    let folder = tempfile::tempdir().unwrap();
    let cornell = |output: &str, more: &[&str]| cornell(folder.path(), output, more);
    assert_mistake(&cornell("none/x.exr", &[]), &["cannot write none/x.exr", "-o"]);
    assert_mistake(&cornell("x.jpg", &[]), &["--output", ".exr"]);
    assert_mistake(&cornell("x.exr", &["--report", "none/r.json"]), &["cannot write none/r.json"]);
    assert_mistake(&cornell("x.exr", &["--memory", "100"]), &["100 bytes", "largest split takes"]);
    assert_mistake(&cornell("x.exr", &["--replicas", "2"]), &["--replicas is 2, but there are 1 nodes"]);
    assert_mistake(&cornell("x.exr", &["--nodes", "3", "--slots", "1,2"]), &["--slots has 2 numbers for 3 nodes"]);
    assert_mistake(&cornell("x.exr", &["--split", "0"]), &["--split is 0"]);
    assert_mistake(&cornell("x.exr", &["--strategy", "magic"]), &["--strategy", "demand-driven"]);
    assert_mistake(&cornell("x.exr", &["--kernel", "neon"]), &["--kernel", "avx2"]);
    assert_mistake(&cornell("x.exr", &["--camera", "0,0,0,0,0,0,0,1,0,40"]), &["--camera", "one point"]);
    assert_mistake(&cornell("x.exr", &["-D", "nothing=1"]), &["nothing"]);
    assert_mistake(&cornell("x.exr", &["--iso", "-300"]), &["iso"]);
    assert_mistake(&rayherd(folder.path(), &["render"]), &["SCENE"]);
    assert_mistake(&rayherd(folder.path(), &["render", "-f", "none.yaml"]), &["cannot read none.yaml"]);
    let scene = repository("examples/cornell-box.xml");
    let huge = ["render", scene.to_str().unwrap(), "--size", "65535x65535"];
    assert_mistake(&rayherd(folder.path(), &huge), &["65535x65535", "GiB", "--size"]);
    assert_eq!(files(folder.path()), [""; 0]);
}

/// Channels of an EXR file by name.
fn channels(path: &Path) -> Vec<(String, Vec<f32>)> {
    use exr::prelude::{FlatSamples, ReadChannels, ReadLayers};
    let reader = exr::prelude::read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer();
    let image = reader.all_attributes().from_file(path).unwrap();
    let list = image.layer_data.channel_data.list.into_iter();
    list.map(|c| match c.sample_data {
        FlatSamples::F32(values) => (c.name.to_string(), values),
        other => panic!("{other:?}"),
    })
    .collect()
}

#[test]
fn aovs_are_layers_of_the_same_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let run = |name: &str, more: &[&str]| {
        let run = cornell(folder.path(), name, more);
        assert_eq!(run.code, 0, "{more:?}: {}", run.err);
        fs::read(at(name)).unwrap()
    };
    let plain = run("plain.exr", &[]);
    assert!(run("none.exr", &["--aov", "none"]) == plain);
    let some = run("some.exr", &["--aov", "normal,depth,albedo"]);
    for more in [
        &["--threads", "2", "--aov", "albedo,normal,depth"][..],
        &["--splits", "5", "--strategy", "demand-driven", "--nodes", "2", "--aov", "depth,albedo,normal"],
        &["--splits", "3", "--strategy", "scheduling-grid", "--slots", "1,2", "--aov", "normal,depth,albedo"],
    ] {
        assert!(run("other.exr", more) == some, "{more:?}");
    }
    let names = |file: &str| channels(&at(file)).into_iter().map(|c| c.0).collect::<Vec<_>>();
    assert_eq!(names("plain.exr"), ["B", "G", "R"]);
    let expected = ["B", "G", "R", "albedo.B", "albedo.G", "albedo.R", "depth.Z", "normal.X", "normal.Y", "normal.Z"];
    assert_eq!(names("some.exr"), expected);
    // the picture is the same, and so is the PNG
    let (with, without) = (channels(&at("some.exr")), channels(&at("plain.exr")));
    assert_eq!(with[..3], without[..]);
    assert_eq!(fs::read(at("some.png")).unwrap(), fs::read(at("plain.png")).unwrap());
    // the camera looks from z = 3.9 at the back wall, at z = -1
    let value = |name: &str, pixel: usize| with.iter().find(|c| c.0 == name).unwrap().1[pixel];
    let back = 16 * 4 + 8;
    assert!(value("depth.Z", back) > 4.9 && value("depth.Z", back) < 5.0, "{}", value("depth.Z", back));
    assert!((value("normal.Z", back) - 1.0).abs() < 1e-6);
    run("all.exr", &["--aov", "all"]);
    assert_eq!(names("all.exr").len(), 3 + 18);
    assert_mistake(&cornell(folder.path(), "x.exr", &["--aov", "depth,colour"]), &["--aov", "\"colour\"", "albedo"]);
}

/// A job's file and Mitsuba's `aov` integrator ask for them too; a flag wins.
#[test]
fn aovs_of_job_files_and_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let example = fs::read_to_string(repository("examples/cornell-box.xml")).unwrap();
    let begin = example.find("<integrator").unwrap();
    let end = begin + example[begin..].find("</integrator>").unwrap() + "</integrator>".len();
    let around = |aovs: &str| {
        let outer = format!("<integrator type=\"aov\"><string name=\"aovs\" value=\"{aovs}\"/>");
        format!("{}{outer}{}</integrator>{}", &example[..begin], &example[begin..end], &example[end..])
    };
    fs::write(at("plain.xml"), &example).unwrap();
    fs::write(at("aov.xml"), around("dd.y:depth, nn:sh_normal")).unwrap();
    let job = "apiVersion: rayherd.io/v1alpha1
kind: RenderJob
spec:
  scene: {source: plain.xml}
  image: {size: 8x8, output: job.exr, aovs: [normal, depth]}
  sampling: {spp: 2}
";
    fs::write(at("job.yaml"), job).unwrap();
    let run = |arguments: &[&str]| {
        let run = rayherd(folder.path(), arguments);
        assert_eq!(run.code, 0, "{arguments:?}: {}", run.err);
    };
    run(&["render", "-f", "job.yaml"]);
    run(&["render", "aov.xml", "--size", "8x8", "--spp", "2", "-o", "scene.exr"]);
    run(&["render", "aov.xml", "--size", "8x8", "--spp", "2", "--aov", "none", "-o", "flag.exr"]);
    run(&["render", "plain.xml", "--size", "8x8", "--spp", "2", "-o", "plain.exr"]);
    let (of_job, of_scene) = (channels(&at("job.exr")), channels(&at("scene.exr")));
    assert_eq!(of_job.len(), 7);
    assert!(of_job == of_scene);
    assert!(channels(&at("flag.exr")) == channels(&at("plain.exr")));
    fs::write(at("bad.yaml"), job.replace("[normal, depth]", "[normal, depths]")).unwrap();
    assert_mistake(&rayherd(folder.path(), &["render", "-f", "bad.yaml"]), &["bad.yaml", "depths", "materialId"]);
    fs::write(at("bad.xml"), around("a:dp_du,b:depth")).unwrap();
    assert_mistake(&rayherd(folder.path(), &["render", "bad.xml"]), &["bad.xml:", "AOV \"dp_du\""]);
    fs::write(at("bad.xml"), around("depth")).unwrap();
    assert_mistake(&rayherd(folder.path(), &["render", "bad.xml"]), &["\"depth\" should be NAME:KIND"]);
}

/// Which files are written, by a flag and by a job's file; of one alone nothing else is left, no preview either.
#[test]
fn files_are_chosen() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let fine = |run: Run| {
        assert_eq!(run.code, 0, "{}", run.err);
        run.out
    };
    fine(cornell(folder.path(), "both.exr", &[]));
    let told = fine(cornell(folder.path(), "one.exr", &["--files", "exr"]));
    assert!(told.starts_with("one.exr: 16x16"), "{told}");
    let told = fine(cornell(folder.path(), "two.exr", &["--files", "png"]));
    assert!(told.starts_with("two.png: 16x16"), "{told}");
    assert_eq!(files(folder.path()), ["both.exr", "both.png", "one.exr", "two.png"]);
    assert!(fs::read(at("one.exr")).unwrap() == fs::read(at("both.exr")).unwrap());
    assert!(fs::read(at("two.png")).unwrap() == fs::read(at("both.png")).unwrap());
    assert_mistake(&cornell(folder.path(), "x.exr", &["--files", "exr,jpg"]), &["--files", "\"jpg\"", "exr, png"]);
    fs::copy(repository("examples/cornell-box.xml"), at("box.xml")).unwrap();
    let job = "{apiVersion: rayherd.io/v1alpha1, kind: RenderJob, spec: {scene: {source: box.xml}, \
        image: {size: 16x16, output: job.exr, files: [Png]}, sampling: {spp: 4}}}";
    fs::write(at("job.yaml"), job).unwrap();
    fine(rayherd(folder.path(), &["render", "-f", "job.yaml"]));
    assert!(!at("job.exr").exists());
    assert!(fs::read(at("job.png")).unwrap() == fs::read(at("both.png")).unwrap());
    for (files, why) in [("[]", "is empty"), ("[Exr, Exr]", "twice")] {
        fs::write(at("bad.yaml"), job.replace("[Png]", files)).unwrap();
        assert_mistake(&rayherd(folder.path(), &["render", "-f", "bad.yaml"]), &["spec.image.files", why]);
    }
}

/// They go on with more samples, and are another picture than one with others.
#[test]
fn aovs_are_resumed() {
    let folder = tempfile::tempdir().unwrap();
    let run = |output: &str, more: &[&str]| {
        let scene = repository("examples/cornell-box.xml");
        let start = ["render", scene.to_str().unwrap(), "--size", "16x16", "-o", output];
        rayherd(folder.path(), &[&start[..], more].concat())
    };
    let fine = |run: Run| assert_eq!(run.code, 0, "{}", run.err);
    fine(run("long.exr", &["--spp", "9", "--aov", "all"]));
    fine(run("short.exr", &["--spp", "3", "--aov", "all", "--store", "s"]));
    fine(run("more.exr", &["--spp", "9", "--aov", "all", "--store", "s", "--resume"]));
    let read = |name: &str| fs::read(folder.path().join(name)).unwrap();
    assert!(read("long.exr") == read("more.exr") && read("long.exr") != read("short.exr"));
    let other = run("other.exr", &["--spp", "9", "--aov", "depth", "--store", "s", "--resume"]);
    assert_mistake(&other, &["aovs", "differs"]);
}
