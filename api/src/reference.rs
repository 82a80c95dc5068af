//! `docs/renderjob.md`: what the definition says, for people. A test writes it and fails when it is old.

use serde_json::Value;

/// The document.
pub fn markdown(definition: &Value) -> String {
    let version = &definition["spec"]["versions"][0];
    let schema = &version["schema"]["openAPIV3Schema"]["properties"];
    let mut text = String::from(
        "# RenderJob\n\n\
         Written from the resource's definition ([crds/renderjob.yaml](../crds/renderjob.yaml)) by a test; do not edit. The same file goes to\n\
         `kubectl apply -f` and to `rayherd render -f`. A field that is left out is taken from the scene file, or has the default named here.\n\n\
         ```yaml\n\
         apiVersion: rayherd.io/v1alpha1\n\
         kind: RenderJob\n\
         metadata: {name: chest}\n\
         spec:\n  \
           scene: {source: scenes/chest/, iso: -789.5}\n  \
           image: {size: 512x512}\n  \
           sampling: {spp: 256}\n  \
           workers: {nodes: 3, slots: [2], memory: 1Gi}\n  \
           replicas: 2\n\
         ```\n",
    );
    let columns: Vec<&str> = version["additionalPrinterColumns"]
        .as_array()
        .into_iter()
        .flatten()
        .filter_map(|c| c["name"].as_str())
        .collect();
    text += &format!("\n`kubectl get rj` shows: {}.\n", columns.join(", "));
    for (part, title) in [("spec", "What is wanted"), ("status", "What became of it")] {
        text += &format!("\n## {part}: {title}\n\n| field | type | default | what it is |\n|---|---|---|---|\n");
        rows(&schema[part], part, &mut text);
    }
    let mut rules = Vec::new();
    collect_rules(&schema["spec"], "spec", &mut rules);
    if !rules.is_empty() {
        text += "\n## What the API server refuses\n\nBeside types and ranges; each with this message.\n\n";
        for (path, message) in rules {
            text += &format!("- `{path}`: {message}\n");
        }
    }
    text
}

fn rows(schema: &Value, path: &str, text: &mut String) {
    let Some(fields) = schema["properties"].as_object() else { return };
    let required: Vec<&str> = schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str).collect();
    for (name, field) in fields {
        let here = format!("{path}.{name}");
        // a field that is an object, or a list of them, has its parts below
        let default = match &field["default"] {
            Value::Null if required.contains(&name.as_str()) => "required".to_owned(),
            Value::Null | Value::Object(_) => String::new(),
            value => format!("`{value}`"),
        };
        let description = cell(field["description"].as_str().unwrap_or_default());
        *text += &format!("| `{here}` | {} | {default} | {description} |\n", kind(field));
        rows(field, &here, text);
        rows(&field["items"], &format!("{here}[]"), text);
    }
}

/// Its type, with the range or the values that it may have.
fn kind(field: &Value) -> String {
    if field["x-kubernetes-int-or-string"] == Value::Bool(true) {
        return "size, such as `128Mi`".into();
    }
    let name = field["type"].as_str().unwrap_or("any");
    if name == "array" {
        return format!("list of {}", kind(&field["items"]));
    }
    let mut text = name.to_owned();
    let number = |v: &Value| v.as_f64().map(|n| if n.abs() < 1e15 { format!("{n}") } else { format!("{n:e}") });
    match (number(&field["minimum"]), number(&field["maximum"])) {
        (Some(least), Some(most)) => text += &format!(", {least} to {most}"),
        (Some(least), None) => text += &format!(", {least} or more"),
        (None, Some(most)) => text += &format!(", at most {most}"),
        (None, None) => {}
    }
    let values: Vec<String> =
        field["enum"].as_array().into_iter().flatten().filter_map(|v| Some(format!("`{}`", v.as_str()?))).collect();
    if values.is_empty() { text } else { values.join(", ") }
}

fn cell(text: &str) -> String {
    text.replace('|', "\\|").split_whitespace().collect::<Vec<_>>().join(" ")
}

fn collect_rules(schema: &Value, path: &str, found: &mut Vec<(String, String)>) {
    for rule in schema["x-kubernetes-validations"].as_array().into_iter().flatten() {
        let message = rule["message"].as_str().unwrap_or_else(|| rule["rule"].as_str().unwrap_or_default());
        found.push((path.to_owned(), cell(message)));
    }
    for (name, field) in schema["properties"].as_object().into_iter().flatten() {
        collect_rules(field, &format!("{path}.{name}"), found);
        collect_rules(&field["items"], &format!("{path}.{name}[]"), found);
    }
}

#[test]
fn the_document_is_what_the_definition_says() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/renderjob.md");
    let definition = serde_json::to_value(crate::resource::definition().unwrap()).unwrap();
    let want = markdown(&definition);
    if std::env::var_os("RAYHERD_UPDATE_CRD").is_some() {
        std::fs::write(path, &want).unwrap();
    }
    let have = std::fs::read_to_string(path).unwrap_or_default();
    assert!(
        have == want,
        "docs/renderjob.md is old: RAYHERD_UPDATE_CRD=1 cargo test --workspace --lib -- the_document"
    );
    // each field of the types has a line that says something
    for line in want.lines().filter(|l| l.starts_with("| `spec.")) {
        assert!(!line.ends_with("|  |"), "no description: {line}");
    }
    for field in
        ["spec.scene.source", "spec.image.cameras[].fov", "spec.workers.keepWarmSeconds", "status.conditions[].reason"]
    {
        assert!(want.contains(&format!("\n| `{field}` | ")), "{field}");
    }
}
