//! The definition's rules and ranges without an API server: a reader of the part of OpenAPI that it uses, and CEL.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use cel::extractors::This;
use cel::{Context, Env, Value as Cel};
use serde_json::{Value, json};

use super::RULES;
use crate::resource::definition;

/// Evaluates CEL as the API server does: with its functions of strings.
struct Rules(Arc<Env>);

impl Rules {
    fn holds(&self, rule: &str, of: &Cel, old: Option<&Cel>) -> bool {
        let program = self.0.compile(rule).unwrap_or_else(|e| panic!("{rule}: {e}"));
        let mut context = Context::with_env(self.0.clone());
        context.add_function("trim", |This(text): This<Arc<String>>| text.trim().to_owned()).unwrap();
        let split = |This(text): This<Arc<String>>, at: Arc<String>| {
            Cel::List(Arc::new(text.split(at.as_str()).map(Cel::from).collect()))
        };
        context.add_function("split", split).unwrap();
        context.add_variable_from_value("self", of.clone());
        if let Some(old) = old {
            context.add_variable_from_value("oldSelf", old.clone());
        }
        match program.execute(&context) {
            Ok(Cel::Bool(yes)) => yes,
            other => panic!("{rule} is {other:?}"),
        }
    }

    /// What the API server says against `new`, which comes in the place of `old`. Fills in defaults, as it does.
    fn against(&self, schema: &Value, (path, new): (&str, &mut Value), old: Option<&Value>, said: &mut Vec<String>) {
        let number = |key: &str| schema.get(key).and_then(Value::as_f64);
        let mut say = |what: &str| said.push(format!("{path}: {what}"));
        let size = match &*new {
            Value::String(s) => s.len(),
            Value::Array(a) => a.len(),
            Value::Object(o) => o.len(),
            _ => 0,
        };
        let beyond = |key: &str| number(key).is_some_and(|most| size as f64 > most);
        let is_int = new.as_f64().is_some_and(|x| x.fract() == 0.0);
        let fits = match schema["type"].as_str() {
            Some("integer") => is_int,
            Some("number") => new.is_number(),
            Some("string") => new.is_string(),
            Some("boolean") => new.is_boolean(),
            Some("array") => new.is_array(),
            Some("object") => new.is_object(),
            _ => schema["x-kubernetes-int-or-string"] == json!(true) && (is_int || new.is_string()),
        };
        if !fits {
            return say("is of another type");
        }
        if let Some(x) = new.as_f64()
            && (number("minimum").is_some_and(|least| x < least) || number("maximum").is_some_and(|most| x > most))
        {
            say("is out of range");
        }
        let few = new.is_array() && number("minItems").is_some_and(|n| (size as f64) < n);
        if few || ["maxItems", "maxLength", "maxProperties"].into_iter().any(beyond) {
            say("has too few or too many");
        }
        if schema["enum"].as_array().is_some_and(|all| !all.contains(new)) {
            say("is none of those that there are");
        }
        if let (Some(pattern), Some(text)) = (schema["pattern"].as_str(), new.as_str())
            && !self.holds(&format!("self.matches({pattern:?})"), &Cel::from(text), None)
        {
            say("does not match");
        }
        if let (Some(fields), Value::Object(given)) = (schema["properties"].as_object(), &mut *new) {
            // null is as if it were left out; what is not known is dropped
            given.retain(|name, value| fields.contains_key(name) && !value.is_null());
            for (name, field) in fields {
                if let Some(default) = field.get("default") {
                    given.entry(name.clone()).or_insert_with(|| default.clone());
                }
                match given.get_mut(name) {
                    Some(value) => {
                        let old = old.and_then(|o| o.get(name));
                        self.against(field, (&format!("{path}.{name}"), value), old, said);
                    }
                    None if schema["required"].as_array().is_some_and(|r| r.contains(&json!(name))) => {
                        said.push(format!("{path}: lacks {name}"));
                    }
                    None => {}
                }
            }
        }
        if let Value::Array(items) = &mut *new {
            // what a list held before is not known by its place
            items.iter_mut().for_each(|i| self.against(&schema["items"], (&format!("{path}[]"), i), None, said));
        }
        for rule in schema["x-kubernetes-validations"].as_array().into_iter().flatten() {
            let text = rule["rule"].as_str().unwrap();
            let old = old.map(|o| cel(schema, o));
            if (old.is_some() || !text.contains("oldSelf")) && !self.holds(text, &cel(schema, new), old.as_ref()) {
                said.push(format!("{path}: {}", rule["message"].as_str().unwrap()));
            }
        }
    }
}

/// A value with the types of its schema: `number` is a double, whatever it looks like.
fn cel(schema: &Value, value: &Value) -> Cel {
    match value {
        Value::Bool(b) => Cel::Bool(*b),
        Value::Number(n) if schema["type"] == "number" => Cel::Float(n.as_f64().unwrap()),
        Value::Number(n) => Cel::Int(n.as_f64().unwrap() as i64),
        Value::String(s) => Cel::from(s.as_str()),
        Value::Array(items) => Cel::List(Arc::new(items.iter().map(|i| cel(&schema["items"], i)).collect())),
        Value::Object(fields) => {
            let of = |name: &String| schema["properties"].get(name).unwrap_or(&schema["additionalProperties"]);
            let fields: HashMap<String, Cel> = fields.iter().map(|(n, v)| (n.clone(), cel(of(n), v))).collect();
            Cel::from(fields)
        }
        Value::Null => Cel::Null,
    }
}

fn schema() -> Value {
    let crd = serde_json::to_value(definition().unwrap()).unwrap();
    crd["spec"]["versions"][0]["schema"]["openAPIV3Schema"].clone()
}

/// What the API server says against a spec, and against the same one changed to `new`.
fn said(rules: &Rules, schema: &Value, old: Option<Value>, mut new: Value) -> Vec<String> {
    let mut said = Vec::new();
    let schema = &schema["properties"]["spec"];
    let old = old.map(|mut old| {
        let mut said = Vec::new();
        rules.against(schema, ("spec", &mut old), None, &mut said);
        assert_eq!(said, [""; 0], "{old}");
        old
    });
    rules.against(schema, ("spec", &mut new), old.as_ref(), &mut said);
    said
}

fn full() -> Value {
    json!({
        "scene": {
            "source": "chest/scan", "iso": -789.5, "albedo": [0.7], "sky": [0.1, 0.2, 0.3], "define": {"n": "4"},
            "lights": [{"origin": [0, 5, 0], "target": [0, 0, 0], "size": [1, 1], "radiance": [10]}],
        },
        "image": {
            "size": "256x256", "output": "a/chest.exr", "prefix": "shots/chest", "exposure": -1.5, "files": ["Png"], "aovs": ["albedo"],
            "cameras": [{"name": "front", "origin": [0, 0, 5], "target": [0, 0, 0], "fov": 40}],
        },
        "sampling": {"spp": 64, "targetError": 0.01, "maxDepth": 8, "rrDepth": 5, "split": 4, "seed": 7},
        "splits": 32,
        "overlapThreshold": 0.2,
        "workers": {"nodes": 4, "slots": [2, 2, 4, 4], "memory": "512Mi"},
        "replicas": 2,
        "storage": {"profile": "fast"},
    })
}

/// `full` with one thing else; null takes it away.
fn with(path: &str, value: Value) -> Value {
    let mut spec = full();
    let (at, name) = path.rsplit_once('/').unwrap();
    let at = spec.pointer_mut(at).unwrap_or_else(|| panic!("{path}"));
    match at {
        Value::Array(items) => items[name.parse::<usize>().unwrap()] = value,
        Value::Object(fields) => drop(fields.insert(name.into(), value)),
        _ => panic!("{path}"),
    }
    spec
}

const HASH: &str = "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef";

/// A job of a prepared scene, and something else.
fn prepared(more: Value) -> Value {
    let mut spec = json!({"scene": {"prepared": HASH}});
    spec.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    spec
}

#[test]
fn every_rule_refuses_what_it_is_for_with_its_message_and_nothing_else() {
    let (rules, schema) = (Rules(Arc::new(Env::stdlib())), schema());
    let light = |name: &str, value: Value| with(&format!("/scene/lights/0/{name}"), value);
    // of a new job
    let mut seen = BTreeSet::new();
    for (spec, message) in [
        (with("/blockSize", json!("64Mi")), "give blockSize or splits, not both"),
        (with("/scene/source", json!("  ")), "spec.scene.source is empty"),
        (with("/scene/source", json!("/etc/passwd")), "is a key in the job's storage"),
        (with("/scene/source", json!("s3://b/a.xml")), "is a key in the job's storage"),
        (with("/scene/source", json!("a/../b.xml")), "is a key in the job's storage"),
        (with("/scene/sky", json!([1, 2])), "spec.scene.sky has one number"),
        (with("/scene/albedo", json!([0.5, 0.5])), "spec.scene.albedo has one number"),
        (light("target", json!([0, 5, 0])), "a light's target is its origin"),
        (light("size", json!([1, 0])), "a width and a height above 0"),
        (light("radiance", json!([1, 0])), "a light's radiance has one number"),
        (with("/image/output", json!("a.png")), "ends in .exr and is a relative path"),
        (with("/image/output", json!("../a.exr")), "ends in .exr and is a relative path"),
        (with("/image/prefix", json!("")), "spec.image.prefix is a relative path"),
        (with("/image/prefix", json!("/shots")), "spec.image.prefix is a relative path"),
        (with("/image/prefix", json!("shots/")), "spec.image.prefix is a relative path"),
        (with("/image/prefix", json!("shots/../jobs")), "spec.image.prefix is a relative path"),
        (with("/image/prefix", json!("jobs/u-1")), "not in deleted, going, jobs, names, objects or uses"),
        (with("/image/cameras/0/target", json!([0, 0, 5])), "a camera's target is its origin"),
        (with("/sampling/targetError", json!(0)), "spec.sampling.targetError is above 0"),
        (with("/sampling/timeLimit", json!(0)), "spec.sampling.timeLimit is above 0"),
        (prepared(json!({"splits": 2})), "is cut already: leave out blockSize and splits"),
        (prepared(json!({"scene": {"prepared": HASH, "source": "a.xml"}})), "source or spec.scene.prepared, not both"),
        (prepared(json!({"scene": {"prepared": HASH, "iso": 1}})), "spec.scene.prepared is imported already"),
        (prepared(json!({"scene": {"prepared": HASH, "substitute": true}})), "spec.scene.prepared is imported already"),
        (prepared(json!({"scene": {}})), "spec.scene.source is empty"),
        (prepared(json!({"workers": {"min": 2}})), "give spec.workers.min and max together"),
        (prepared(json!({"workers": {"min": 3, "max": 2}})), "spec.workers.min is at most max"),
        (prepared(json!({"workers": {"nodes": 2, "min": 1, "max": 2}})), "give spec.workers.nodes, or min and max"),
        (prepared(json!({"workers": {"min": 2, "max": 2, "slots": [1, 1]}})), "spec.workers.slots has one number"),
        (with("/workers/slots", json!([1, 2])), "one number for all workers, or one for each"),
    ] {
        let said = said(&rules, &schema, None, spec);
        assert!(said.len() == 1 && said[0].contains(message), "{message}: {said:?}");
        seen.insert(said[0].split_once(": ").unwrap().1.to_owned());
    }
    for taken in crate::ImageSpec::TAKEN {
        let said = said(&rules, &schema, None, with("/image/prefix", json!(format!("{taken}/a"))));
        assert!(said.len() == 1 && said[0].contains("which are Rayherd's own"), "{taken}: {said:?}");
    }
    // of one that is changed
    for (path, value, message) in [
        ("/splits", json!(33), "spec.splits cannot be changed"),
        ("/splits", json!(null), "spec.splits cannot be changed"),
        ("/replicas", json!(3), "spec.replicas cannot be changed"),
        ("/replicas", json!(1), "spec.replicas cannot be changed"),
        ("/replicas", json!(null), "spec.replicas cannot be changed"),
        ("/overlapThreshold", json!(0.3), "spec.overlapThreshold cannot be changed"),
        ("/scene/source", json!("other"), "the scene of a job cannot be changed"),
        ("/scene/iso", json!(1), "the scene of a job cannot be changed"),
        ("/scene/sky", json!(null), "the scene of a job cannot be changed"),
        ("/scene/substitute", json!(true), "the scene of a job cannot be changed"),
        ("/scene/define/n", json!("5"), "the scene of a job cannot be changed"),
        ("/scene/lights/0/size", json!([1, 2]), "the scene of a job cannot be changed"),
        ("/image/size", json!("256x255"), "spec.image.size cannot be changed"),
        ("/image/cameras/0/fov", json!(41), "spec.image.cameras cannot be changed"),
        ("/image/cameras", json!(null), "spec.image.cameras cannot be changed"),
        ("/image/aovs", json!([]), "spec.image.aovs cannot be changed"),
        ("/image/output", json!("b.exr"), "spec.image.output cannot be changed"),
        ("/image/prefix", json!(null), "spec.image.prefix cannot be changed"),
        ("/sampling/targetError", json!(0.02), "can be lowered or taken away only"),
        ("/sampling/spp", json!(63), "spec.sampling.spp can be raised only"),
        ("/sampling/seed", json!(8), "the seed of a job cannot be changed"),
        ("/sampling/seed", json!(null), "the seed of a job cannot be changed"),
        ("/sampling/maxDepth", json!(9), "spec.sampling.maxDepth cannot be changed"),
        ("/sampling/rrDepth", json!(null), "spec.sampling.rrDepth cannot be changed"),
        ("/sampling/split", json!(1), "spec.sampling.split cannot be changed"),
        ("/managedBy", json!("kueue.x-k8s.io/multikueue"), "spec.managedBy cannot be changed"),
        ("/storage/profile", json!("slow"), "the storage of a job cannot be changed"),
        ("/storage/secret", json!("other"), "the storage of a job cannot be changed"),
    ] {
        let said = said(&rules, &schema, Some(full()), with(path, value));
        assert!(said.len() == 1 && said[0].contains(message), "{path}: {said:?}");
        seen.insert(said[0].split_once(": ").unwrap().1.to_owned());
    }
    let mut sized = full();
    sized["splits"] = json!(null);
    sized["blockSize"] = json!("64Mi");
    let mut bigger = sized.clone();
    bigger["blockSize"] = json!("65Mi");
    let found = said(&rules, &schema, Some(sized), bigger);
    assert_eq!(found, ["spec: spec.blockSize cannot be changed: make another job"]);
    seen.insert(found[0].split_once(": ").unwrap().1.to_owned());
    let all: BTreeSet<String> = RULES.iter().map(|(_, _, message)| (*message).to_owned()).collect();
    assert_eq!(seen, all, "a rule that nothing breaks here is not tested");
}

#[test]
fn what_may_change_while_a_job_runs_may() {
    let (rules, schema) = (Rules(Arc::new(Env::stdlib())), schema());
    let least = json!({"scene": {"source": "a.ply"}});
    assert_eq!(said(&rules, &schema, Some(least.clone()), least.clone()), [""; 0]);
    // defaults that are written out change nothing
    let told = json!({
        "scene": {"source": "a.ply", "substitute": false}, "sampling": {"seed": 0, "split": 1}, "replicas": 1,
        "storage": {"profile": "default", "secret": "rayherd-storage"}, "overlapThreshold": 0.2,
    });
    assert_eq!(said(&rules, &schema, Some(least), told), [""; 0]);
    for (path, value) in [
        ("/sampling/spp", json!(65)),
        ("/sampling/targetError", json!(0.001)),
        ("/sampling/targetError", json!(null)),
        ("/sampling/timeLimit", json!(60)),
        ("/image/exposure", json!(2)),
        ("/image/files", json!(["Exr", "Png"])),
        ("/strategy", json!("DemandDriven")),
        ("/barrier", json!(true)),
        ("/workers/slots", json!([3])),
        ("/workers/memory", json!(1 << 30)),
        ("/workers/keepWarmSeconds", json!(60)),
        ("/workers/template", json!({"spec": {"priorityClassName": "night"}})),
        ("/placement", json!("None")),
        ("/suspend", json!(true)),
        ("/activeDeadlineSeconds", json!(60)),
        ("/ttlSecondsAfterFinished", json!(0)),
        ("/taskSeconds", json!(1)),
    ] {
        assert_eq!(said(&rules, &schema, Some(full()), with(path, value)), [""; 0], "{path}");
    }
    let bounds = |max: i32| prepared(json!({"workers": {"min": 1, "max": max, "slots": [2]}}));
    assert_eq!(said(&rules, &schema, Some(bounds(2)), bounds(3)), [""; 0]);
    let mut more = with("/workers/nodes", json!(5));
    more["workers"]["slots"] = json!([2]);
    assert_eq!(said(&rules, &schema, Some(full()), more), [""; 0]);
}

#[test]
fn ranges_are_in_the_schema() {
    let (rules, schema) = (Rules(Arc::new(Env::stdlib())), schema());
    for (path, value) in [
        ("/scene/sky/0", json!(-0.1)),
        ("/scene/sky", json!([])),
        ("/scene/sky", json!([1, 1, 1, 1])),
        ("/scene/albedo/0", json!(1.1)),
        ("/scene/albedo/0", json!(-0.1)),
        ("/scene/lights/0/radiance/0", json!(-1)),
        ("/scene/lights/0/radiance", json!([1, 1, 1, 1])),
        ("/image/size", json!("0x5")),
        ("/image/exposure", json!(33)),
        ("/image/files", json!([])),
        ("/image/files/0", json!("Jpg")),
        ("/image/cameras/0/name", json!("a b")),
        ("/image/cameras/0/name", json!("")),
        ("/image/cameras/0/fov", json!(0)),
        ("/image/cameras/0/up", json!([0, 1])),
        ("/image/aovs/0", json!("beauty")),
        ("/sampling/spp", json!(0)),
        ("/sampling/split", json!(513)),
        ("/sampling/maxDepth", json!(65536)),
        ("/sampling/rrDepth", json!(0)),
        ("/sampling/seed", json!(-1)),
        ("/scene/prepared", json!("0123")),
        ("/managedBy", json!("me")),
        ("/workers/nodes", json!(0)),
        ("/workers/min", json!(0)),
        ("/workers/max", json!(4097)),
        ("/workers/slots/0", json!(0)),
        ("/workers/slots/0", json!(1025)),
        ("/workers/memory", json!("many")),
        ("/workers/keepWarmSeconds", json!(86401)),
        ("/splits", json!(0)),
        ("/overlapThreshold", json!(1.1)),
        ("/replicas", json!(17)),
        ("/taskSeconds", json!(0)),
        ("/placement", json!("Near")),
        ("/activeDeadlineSeconds", json!(0)),
        ("/ttlSecondsAfterFinished", json!(-1)),
    ] {
        let found = said(&rules, &schema, None, with(path, value.clone()));
        let said = |f: &String| ["range", "too few", "match", "none of those"].iter().any(|w| f.contains(w));
        assert!(found.iter().any(said), "{path} = {value}: {found:?}");
    }
}

/// The server adds up what rules can cost from these bounds.
#[test]
fn whatever_rules_walk_over_is_bounded() {
    fn look(path: &str, schema: &Value) {
        match schema["type"].as_str() {
            Some("string") if schema.get("enum").is_none() && schema.get("format").is_none() => {
                assert!(schema["maxLength"].as_u64().is_some_and(|n| n <= 1024), "{path}");
            }
            Some("array") => assert!(schema["maxItems"].as_u64().is_some_and(|n| n <= 4096), "{path}"),
            Some("object") if schema.get("additionalProperties").is_some() => {
                assert!(schema["maxProperties"].as_u64().is_some_and(|n| n <= 1024), "{path}");
            }
            _ => {}
        }
        for (name, field) in schema["properties"].as_object().into_iter().flatten() {
            look(&format!("{path}.{name}"), field);
        }
        if let Some(items) = schema.get("items") {
            look(&format!("{path}[]"), items);
        }
    }
    look("", &schema()["properties"]["spec"]);
}
