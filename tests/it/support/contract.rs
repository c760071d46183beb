//! Holds answers to `openapi.yaml`: the status, media type, headers and body schema must be listed there.

use std::{
    collections::BTreeSet,
    sync::{Arc, LazyLock, Mutex},
};

use reqwest::header::HeaderMap;
use serde_json::{Value, json};
use tcgs::domain::Scope;

static DOCUMENT: LazyLock<Value> = LazyLock::new(|| {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml");
    let text = std::fs::read_to_string(path).expect("openapi.yaml is readable");
    let mut document = yaml_serde::from_str(&text).expect("openapi.yaml is YAML");
    close_objects(&mut document);
    document
});

/// What was seen of the contract; clones share it.
#[derive(Debug, Clone, Default)]
pub struct Coverage(Arc<Mutex<BTreeSet<(String, String)>>>);

impl Coverage {
    /// Every (operation, status) of the contract that was not seen.
    pub fn missing(&self) -> BTreeSet<(String, String)> {
        let seen = self.0.lock().expect("no test panicked while it held this").clone();
        operations().difference(&seen).cloned().collect()
    }

    /// Panics unless the answer is one that the contract lists.
    pub fn check(&self, method: &str, path: &str, status: u16, headers: &HeaderMap, body: &[u8]) {
        let place = format!("{method} {path} -> {status}");
        assert!(headers.contains_key("x-request-id"), "{place}: no X-Request-Id");
        let shown_by = headers.get("cross-origin-resource-policy").map(|value| value.as_bytes());
        assert_eq!(shown_by, Some(&b"same-origin"[..]), "{place}: no Cross-Origin-Resource-Policy");
        let media_type = headers.get("content-type").map(|value| {
            value.to_str().expect("ASCII").split(';').next().unwrap_or_default().trim().to_owned()
        });
        let is_cross_site = || {
            let problem: Value = serde_json::from_slice(body).unwrap_or_default();
            problem["type"] == "urn:tcgs:problem:cross-site-request"
        };
        if matches!(status, 414 | 421 | 431) || (status == 403 && is_cross_site()) {
            // For any operation, as the contract's common rules say.
            return validate(&place, &json!({ "$ref": "#/components/schemas/Problem" }), body);
        }
        let Some(operation) = operation(method, path) else {
            assert!(matches!(status, 401 | 404 | 405 | 429), "{place}: not in the contract");
            if status == 405 {
                assert!(headers.contains_key("allow"), "{place}: no Allow");
            }
            assert_eq!(media_type.as_deref(), Some("application/problem+json"), "{place}");
            if method != "HEAD" {
                validate(&place, &json!({ "$ref": "#/components/schemas/Problem" }), body);
            }
            return;
        };
        let listed = resolved(&operation["responses"][status.to_string()]);
        assert!(listed.is_object(), "{place}: the status is not listed");
        for (name, header) in listed["headers"].as_object().into_iter().flatten() {
            let header = resolved(header);
            match headers.get(name) {
                None => assert_ne!(header["required"], json!(true), "{place}: no {name}"),
                Some(value) => {
                    let text = value.to_str().expect("ASCII");
                    let value = match header["schema"]["type"].as_str() {
                        Some("integer") => json!(text.parse::<i64>().expect("an integer")),
                        Some("number") => json!(text.parse::<f64>().expect("a number")),
                        _ => json!(text),
                    };
                    let body = serde_json::to_vec(&value).expect("JSON");
                    validate(&format!("{place}: {name}"), &header["schema"], &body);
                }
            }
        }
        match (listed["content"].as_object(), &media_type) {
            (None, None) => assert!(body.is_empty(), "{place}: a body that is not listed"),
            (None, Some(media_type)) => panic!("{place}: {media_type} is not listed"),
            (Some(_), None) => panic!("{place}: no Content-Type"),
            (Some(content), Some(media_type)) => {
                let listed = content.get(media_type);
                let listed = listed.unwrap_or_else(|| panic!("{place}: {media_type} is not listed"));
                match listed.get("schema") {
                    Some(schema) if media_type == "text/event-stream" => {
                        super::sse::frames(body)
                            .iter()
                            .for_each(|frame| validate_frame(&place, schema, frame));
                    }
                    Some(schema) if method != "HEAD" => validate(&place, schema, body),
                    _ => {}
                }
            }
        }
        let id = operation["operationId"].as_str().expect("an operationId").to_owned();
        self.0.lock().expect("no test panicked while it held this").insert((id, status.to_string()));
    }
}

/// An operation that needs a key.
#[derive(Debug, Clone)]
pub struct Guarded {
    pub id: String,
    pub method: &'static str,
    pub scope: Scope,
    /// The path with its parameters in braces.
    pub template: String,
}

impl Guarded {
    /// A path of the operation, to something that is not there.
    pub fn path(&self) -> String {
        let parts: Vec<&str> = self
            .template
            .split('/')
            .map(|part| if part.starts_with('{') { "0190a5d8-0000-7000-8000-000000000000" } else { part })
            .collect();
        parts.join("/")
    }
}

/// Every operation of the contract that needs a key.
pub fn guarded() -> Vec<Guarded> {
    const METHODS: [(&str, &str); 7] = [
        ("get", "GET"),
        ("head", "HEAD"),
        ("post", "POST"),
        ("put", "PUT"),
        ("patch", "PATCH"),
        ("delete", "DELETE"),
        ("options", "OPTIONS"),
    ];
    let mut all = Vec::new();
    for (template, item) in DOCUMENT["paths"].as_object().expect("paths") {
        for (name, method) in METHODS {
            let Some(operation) = item.get(name) else { continue };
            let Some(scope) = operation["security"][0]["key"][0].as_str() else { continue };
            let id = operation["operationId"].as_str().expect("an operationId").to_owned();
            let scope = scope.parse().expect("a scope");
            all.push(Guarded { id, method, scope, template: template.clone() });
        }
    }
    assert!(!all.is_empty());
    all
}

fn operations() -> BTreeSet<(String, String)> {
    let mut all = BTreeSet::new();
    for path in DOCUMENT["paths"].as_object().expect("paths").values() {
        for operation in path.as_object().expect("a path").values().filter(|value| value.is_object()) {
            let id = operation["operationId"].as_str().expect("an operationId");
            let statuses = operation["responses"].as_object().expect("responses").keys();
            all.extend(statuses.map(|status| (id.to_owned(), status.clone())));
        }
    }
    all
}

fn operation(method: &str, path: &str) -> Option<&'static Value> {
    let path = path.split('?').next().unwrap_or_default();
    let fits = |template: &str| {
        let (mut left, mut right) = (template.split('/'), path.split('/'));
        loop {
            match (left.next(), right.next()) {
                (None, None) => return true,
                (Some(a), Some(b)) if a == b || (a.starts_with('{') && !b.is_empty()) => {}
                _ => return false,
            }
        }
    };
    let (_, item) = DOCUMENT["paths"].as_object()?.iter().find(|(template, _)| fits(template))?;
    let listed = item.get(method.to_lowercase());
    if method == "HEAD" { listed.or_else(|| item.get("get")) } else { listed }
}

/// The target of a `$ref`, or the value itself.
fn resolved(value: &'static Value) -> &'static Value {
    match value["$ref"].as_str() {
        Some(reference) => DOCUMENT.pointer(&reference[1..]).expect("the reference leads somewhere"),
        None => value,
    }
}

/// A frame of an event stream, and what its data holds.
fn validate_frame(place: &str, schema: &'static Value, frame: &super::sse::Frame) {
    let mut fields = json!({ "event": frame.event, "data": frame.data });
    if !frame.id.is_empty() {
        fields["id"] = json!(frame.id);
    }
    validate(place, schema, &serde_json::to_vec(&fields).expect("JSON"));
    validate(place, &resolved(schema)["properties"]["data"]["contentSchema"], frame.data.as_bytes());
}

fn validate(place: &str, schema: &Value, body: &[u8]) {
    let body: Value = serde_json::from_slice(body)
        .unwrap_or_else(|error| panic!("{place}: {error}: {}", String::from_utf8_lossy(body)));
    let whole = json!({ "allOf": [schema], "components": DOCUMENT["components"] });
    let validator = jsonschema::options()
        .with_draft(jsonschema::Draft::Draft202012)
        .should_validate_formats(true)
        .build(&whole)
        .expect("a schema");
    let faults: Vec<_> =
        validator.iter_errors(&body).map(|error| format!("{} at {}", error, error.instance_path())).collect();
    assert!(faults.is_empty(), "{place}: {}\n{body:#}", faults.join("; "));
}

/// Makes every object schema exact, so that a field which is served but not written down is found.
fn close_objects(value: &mut Value) {
    match value {
        Value::Object(map) => {
            let is_schema = map.get("type") == Some(&json!("object")) && map.contains_key("properties");
            if is_schema && !map.contains_key("additionalProperties") {
                map.insert("additionalProperties".into(), json!(false));
            }
            map.values_mut().for_each(close_objects);
        }
        Value::Array(items) => items.iter_mut().for_each(close_objects),
        _ => {}
    }
}

#[test]
fn every_reference_in_the_contract_leads_somewhere() {
    fn walk(value: &Value) {
        match value {
            Value::Object(map) => {
                if let Some(reference) = map.get("$ref").and_then(Value::as_str) {
                    let target = DOCUMENT.pointer(&reference[1..]);
                    assert!(target.is_some(), "{reference} leads nowhere");
                }
                map.values().for_each(walk);
            }
            Value::Array(items) => items.iter().for_each(walk),
            _ => {}
        }
    }
    walk(&DOCUMENT);
}
