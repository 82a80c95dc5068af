//! What a store says about the jobs that it holds, so that `--resume` goes on with the one that was meant, or says why not.

use std::collections::BTreeSet;

use anyhow::Context;
use rayherd_herd::job::PreparedScene;
use rayherd_render::frame::Frame;
use rayherd_scene::objects::ObjectHash;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::fault::Mistake;
use crate::store::{JOBS, Store};

/// Name of the note beside a job's records.
const NOTE: &str = "about";

/// What defines a job's picture, for people.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct About {
    /// Where the scene was read from.
    source: String,
    /// Hash of the scene's content.
    content: ObjectHash,
    /// The frame: an object of its parts.
    frame: Value,
}

impl About {
    /// Of a frame of a scene.
    pub fn new(source: &str, scene: &PreparedScene, frame: &Frame) -> anyhow::Result<Self> {
        let path = std::fs::canonicalize(source).map_or_else(|_| source.to_owned(), |p| p.display().to_string());
        let frame = serde_json::to_value(frame).context("cannot write the frame down")?;
        Ok(About { source: path, content: scene.manifest.content, frame })
    }

    /// What of another one is different, in words; none if they have nothing in common.
    fn differences(&self, kept: &About) -> Option<Vec<String>> {
        if self.source != kept.source && self.content != kept.content {
            return None;
        }
        let mut out = Vec::new();
        if self.content != kept.content {
            out.push("the scene's content (its source, or an option that makes the scene, was changed)".to_owned());
        }
        let (Value::Object(ours), Value::Object(theirs)) = (&self.frame, &kept.frame) else { return Some(out) };
        let names: BTreeSet<&String> = ours.keys().chain(theirs.keys()).collect();
        for name in names.into_iter().filter(|n| ours.get(*n) != theirs.get(*n)) {
            let text = |v: Option<&Value>| v.map_or_else(|| "none".into(), Value::to_string);
            out.push(match name.as_str() {
                // a matrix says nothing to people; it changes with the size too
                "camera" => "the camera".to_owned(),
                name => format!("{name} ({}, not {})", text(theirs.get(name)), text(ours.get(name))),
            });
        }
        Some(out)
    }
}

/// Prefix of the job of a picture, named by [`PreparedScene::image_name`].
pub fn prefix(image: &str) -> String {
    format!("{JOBS}{}", &image[..16])
}

/// Notes beside a job what it is about to be.
pub fn note(store: &Store, image: &str, about: &About) -> anyhow::Result<()> {
    let body = serde_json::to_vec(about).context("cannot write down what the job is")?;
    Ok(store.wait(store.blocks.put(&format!("{}/{NOTE}", prefix(image)), body.into()))?)
}

/// Refuses to resume when none of the pictures was begun, but the store holds others of the same scene: beginning anew without a
/// word is not what was asked for.
pub fn check_resumed(store: &Store, place: &str, pictures: &[(String, About)]) -> anyhow::Result<()> {
    let mut begun = BTreeSet::new();
    let mut notes = Vec::new();
    for (key, _) in store.wait(store.blocks.list(JOBS))? {
        let Some((job, rest)) = key[JOBS.len()..].split_once('/') else { continue };
        if rest.starts_with("records/") {
            begun.insert(format!("{JOBS}{job}"));
        } else if rest == NOTE {
            notes.push((format!("{JOBS}{job}"), key));
        }
    }
    if pictures.iter().any(|(image, _)| begun.contains(&prefix(image))) {
        return Ok(());
    }
    let Some((_, wanted)) = pictures.first() else { return Ok(()) };
    let mut nearest: Option<(Vec<String>, About)> = None;
    for (_, key) in notes.into_iter().filter(|(job, _)| begun.contains(job)) {
        let body = store.wait(store.blocks.get(&key))?;
        // one that cannot be read says nothing
        let Ok(kept) = serde_json::from_slice::<About>(&body) else { continue };
        if let Some(found) = wanted.differences(&kept)
            && nearest.as_ref().is_none_or(|(least, _)| found.len() < least.len())
        {
            nearest = Some((found, kept));
        }
    }
    let Some((differs, kept)) = nearest else {
        tracing::warn!("{place} holds no job of this scene to go on with: it is begun");
        return Ok(());
    };
    let differs = if differs.is_empty() { "how it is written down".to_owned() } else { differs.join(", ") };
    Err(Mistake(format!(
        "{place} holds no job of this picture to go on with; the nearest that it holds, of {}, differs in {differs}: undo that to go on \
         with it, or leave --resume out, or name another folder with --store, to begin this one",
        kept.source
    ))
    .into())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn what_differs_is_named() {
        let about = |source: &str, content: u8, frame: Value| About {
            source: source.into(),
            content: ObjectHash([content; 32]),
            frame,
        };
        let wanted = about("a.xml", 1, json!({"size": [32, 32], "seed": 0, "camera": {"x": 1}}));
        let same = wanted.differences(&wanted);
        assert_eq!(same, Some(vec![]));
        let kept = about("a.xml", 2, json!({"size": [64, 32], "seed": 0, "camera": {"x": 2}}));
        let found = wanted.differences(&kept).unwrap().join("; ");
        assert!(found.contains("content") && found.contains("the camera") && !found.contains("seed"), "{found}");
        assert!(found.contains("size ([64,32], not [32,32])"), "{found}");
        // moved, but the same; another scene altogether
        assert_eq!(wanted.differences(&About { source: "b.xml".into(), ..wanted.clone() }), Some(vec![]));
        assert_eq!(wanted.differences(&about("b.xml", 2, json!({}))), None);
    }
}
