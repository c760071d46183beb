//! Holds answers to `openapi.yaml`: the status, media type, headers and body schema must be listed there.

use std::{
    collections::BTreeSet,
    sync::{Arc, LazyLock, Mutex},
};

use reqwest::header::HeaderMap;
use serde_json::{Value, json};
use tcgs::{domain::Scope, viewer_page::assets};

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
    /// Every (operation, status) of the contract that was not seen. A request with an overridden method is answered by that method's
    /// operation, so a status of that one counts for it too. Datasets have the same handlers under both of their names.
    pub fn missing(&self) -> BTreeSet<(String, String)> {
        const OVERRIDDEN: [&str; 3] = ["getUpload", "appendToUpload", "deleteUpload"];
        let mut seen = self.0.lock().expect("no test panicked while it held this").clone();
        let by_override: Vec<_> = seen
            .iter()
            .filter(|(operation, _)| OVERRIDDEN.contains(&operation.as_str()))
            .map(|(_, status)| ("overrideUploadMethod".to_owned(), status.clone()))
            .collect();
        seen.extend(by_override);
        let by_name: Vec<_> = seen
            .iter()
            .filter(|(operation, _)| operation.contains("Scene"))
            .map(|(operation, status)| (operation.replace("Scene", "Dataset"), status.clone()))
            .collect();
        seen.extend(by_name);
        // Only a program that was built after the viewer for browsers serves it.
        let is_served = |operation: &str| assets().is_some() || !operation.starts_with("viewer");
        operations().difference(&seen).filter(|(operation, _)| is_served(operation)).cloned().collect()
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
        let is_closed_link = path.starts_with("/s/") && status == 404 && method != "HEAD";
        if matches!(status, 414 | 421 | 431) || (status == 403 && is_cross_site()) || is_closed_link {
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
                    Some(schema) if method != "HEAD" => {
                        let is_part = path.contains("?fields=") || path.contains("&fields=");
                        validate_with(&place, schema, body, if is_part { "JobFields" } else { "Job" });
                    }
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
    // A shared link has the operations of what it opens.
    let below = path.strip_prefix("/s/").and_then(|path| path.find('/').map(|end| &path[end..]));
    let path = below.unwrap_or(path);
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
    validate_with(place, schema, body, "Job");
}

/// Validates an answer in which jobs are shown as the schema `shown_job`: whole, unless the request names fields.
fn validate_with(place: &str, schema: &Value, body: &[u8], shown_job: &str) {
    let body: Value = serde_json::from_slice(body)
        .unwrap_or_else(|error| panic!("{place}: {error}: {}", String::from_utf8_lossy(body)));
    let mut whole = json!({ "allOf": [schema], "components": DOCUMENT["components"] });
    whole["components"]["schemas"]["ShownJob"] =
        json!({ "$ref": format!("#/components/schemas/{shown_job}") });
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

/// The objects of OpenAPI 3.1 that the contract uses, each with its fields and what they hold: `text` is prose, `any` anything,
/// `[x]` a list and `{x}` a map of x, else the name of an object.
const OBJECTS: &[(&str, &[(&str, &str)])] = &[
    (
        "document",
        &[
            ("openapi", "any"),
            ("info", "info"),
            ("servers", "any"),
            ("tags", "any"),
            ("paths", "{path}"),
            ("components", "components"),
        ],
    ),
    (
        "info",
        &[
            ("title", "any"),
            ("version", "any"),
            ("summary", "text"),
            ("license", "any"),
            ("description", "text"),
        ],
    ),
    (
        "components",
        &[
            ("securitySchemes", "{security}"),
            ("parameters", "{parameter}"),
            ("headers", "{header}"),
            ("responses", "{response}"),
            ("schemas", "{schema}"),
            ("examples", "{example}"),
        ],
    ),
    (
        "security",
        &[
            ("in", "any"),
            ("name", "any"),
            ("type", "any"),
            ("scheme", "any"),
            ("bearerFormat", "any"),
            ("description", "text"),
        ],
    ),
    (
        "path",
        &[
            ("parameters", "[parameter]"),
            ("get", "operation"),
            ("head", "operation"),
            ("post", "operation"),
            ("put", "operation"),
            ("patch", "operation"),
            ("delete", "operation"),
            ("options", "operation"),
        ],
    ),
    (
        "operation",
        &[
            ("operationId", "any"),
            ("security", "any"),
            ("tags", "any"),
            ("summary", "text"),
            ("description", "text"),
            ("parameters", "[parameter]"),
            ("requestBody", "body"),
            ("responses", "{response}"),
        ],
    ),
    (
        "parameter",
        &[
            ("$ref", "any"),
            ("name", "any"),
            ("in", "any"),
            ("required", "any"),
            ("description", "text"),
            ("style", "any"),
            ("explode", "any"),
            ("schema", "schema"),
            ("example", "any"),
            ("deprecated", "any"),
        ],
    ),
    ("body", &[("required", "any"), ("description", "text"), ("content", "{media}")]),
    ("media", &[("schema", "schema"), ("example", "any"), ("examples", "{example}")]),
    ("example", &[("$ref", "any"), ("summary", "text"), ("value", "any")]),
    (
        "response",
        &[("$ref", "any"), ("description", "text"), ("headers", "{header}"), ("content", "{media}")],
    ),
    ("header", &[("$ref", "any"), ("required", "any"), ("description", "text"), ("schema", "schema")]),
    (
        "schema",
        &[
            ("$ref", "any"),
            ("type", "any"),
            ("description", "text"),
            ("properties", "{schema}"),
            ("required", "any"),
            ("additionalProperties", "schema"),
            ("propertyNames", "schema"),
            ("maxProperties", "any"),
            ("items", "schema"),
            ("enum", "any"),
            ("const", "any"),
            ("anyOf", "[schema]"),
            ("oneOf", "[schema]"),
            ("allOf", "[schema]"),
            ("minimum", "any"),
            ("maximum", "any"),
            ("exclusiveMinimum", "any"),
            ("exclusiveMaximum", "any"),
            ("minItems", "any"),
            ("maxItems", "any"),
            ("uniqueItems", "any"),
            ("minLength", "any"),
            ("maxLength", "any"),
            ("pattern", "any"),
            ("format", "any"),
            ("default", "any"),
            ("examples", "any"),
            ("deprecated", "any"),
            ("contentMediaType", "any"),
            ("contentSchema", "schema"),
        ],
    ),
];

/// Adds what is wrong with `value` as a `kind` to `faults`.
fn find_faults(value: &Value, kind: &str, place: &str, faults: &mut Vec<String>) {
    let inner = |open: char, close: char| kind.strip_prefix(open).and_then(|kind| kind.strip_suffix(close));
    if let Some(kind) = inner('[', ']') {
        let items = value.as_array().into_iter().flatten().enumerate();
        items.for_each(|(index, item)| find_faults(item, kind, &format!("{place}[{index}]"), faults));
    } else if let Some(kind) = inner('{', '}') {
        let fields = value.as_object().into_iter().flatten();
        fields.for_each(|(name, field)| find_faults(field, kind, &format!("{place}/{name}"), faults));
    } else if kind == "text" {
        let text = value.as_str().unwrap_or_default().trim_end();
        let is_code = text.lines().last().is_some_and(|line| line.starts_with("    "));
        if !(text.ends_with('.') || is_code) {
            faults.push(format!("{place} does not end: {value}"));
        }
    } else if let (Some((_, known)), Some(fields)) =
        (OBJECTS.iter().find(|(name, _)| *name == kind), value.as_object())
    {
        for (name, field) in fields {
            let place = format!("{place}/{name}");
            match known.iter().find(|(known, _)| known == name) {
                Some((_, kind)) => find_faults(field, kind, &place, faults),
                None => faults.push(format!("{place} is no field of a {kind}: {field}")),
            }
        }
    }
}

#[test]
fn the_contract_parses_into_what_it_means() {
    let mut faults = Vec::new();
    find_faults(&DOCUMENT, "document", "", &mut faults);
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    // What an unquoted comma within braces makes of a description.
    let broken = json!({ "description": "Training PSNR in dB", "averaged over recent steps.": null });
    find_faults(&broken, "schema", "psnr", &mut faults);
    assert_eq!(faults.len(), 2, "{faults:?}");
}

#[test]
fn examples_are_what_their_schemas_say() {
    fn walk(value: &Value, place: &str, seen: &mut usize) {
        match value {
            Value::Object(map) => {
                if let (Some(schema), Some(example)) = (map.get("schema"), map.get("example")) {
                    validate(place, schema, &serde_json::to_vec(example).expect("JSON"));
                    *seen += 1;
                }
                map.iter().for_each(|(name, value)| walk(value, &format!("{place}/{name}"), seen));
            }
            Value::Array(items) => items.iter().for_each(|item| walk(item, place, seen)),
            _ => {}
        }
    }
    let mut seen = 0;
    walk(&DOCUMENT["paths"], "", &mut seen);
    assert!(seen >= 10, "{seen} examples");
}

/// A client that sends every default has to be answered as one that sends none; where that is not so, the description says
/// what holds if a parameter is absent.
#[test]
fn parameters_have_defaults_only_where_they_may_always_be_sent() {
    for id in ["createJob", "getView"] {
        let items = DOCUMENT["paths"].as_object().expect("paths").values();
        let operation = items
            .flat_map(|item| item.as_object().expect("a path").values())
            .find(|it| it["operationId"] == id);
        for parameter in
            operation.expect("there").get("parameters").and_then(Value::as_array).expect("parameters")
        {
            let parameter = resolved(parameter);
            let alone = matches!(parameter["name"].as_str(), Some("output" | "format"));
            assert!(alone || parameter["schema"].get("default").is_none(), "{id}: {parameter}");
        }
    }
}
