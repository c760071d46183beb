//! The access that each operation requires, in one table.
//!
//! An operation without a row is not served: see [`crate::http::auth`]. A test compares the table with `openapi.yaml`.

use crate::domain::Scope;

/// The access that an operation requires.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Access {
    /// None: everybody may call it.
    Open,
    /// A key with this scope, once there are keys.
    Scope(Scope),
    /// None; whoever shows a key must have this scope, and is answered by what it may see.
    Optional(Scope),
}

impl Access {
    /// The scope that a key must have.
    pub(crate) fn scope(self) -> Option<Scope> {
        match self {
            Access::Open => None,
            Access::Scope(scope) | Access::Optional(scope) => Some(scope),
        }
    }
}

use Access::{Open, Optional, Scope as Needs};
use Scope::{Admin, DatasetsWrite, JobsWrite, Read};

/// Method and route of every operation, as the router has them, in the order of `openapi.yaml`.
const OPERATIONS: &[(&str, &str, Access)] = &[
    ("POST", "/v1/jobs", Needs(JobsWrite)),
    ("GET", "/v1/jobs", Needs(Read)),
    ("POST", "/v1/estimate", Needs(Read)),
    ("GET", "/v1/jobs/{id}", Needs(Read)),
    ("PATCH", "/v1/jobs/{id}", Needs(JobsWrite)),
    ("DELETE", "/v1/jobs/{id}", Needs(JobsWrite)),
    ("POST", "/v1/jobs/{id}/retry", Needs(JobsWrite)),
    ("POST", "/v1/jobs/{id}/cancel", Needs(JobsWrite)),
    ("GET", "/v1/jobs/{id}/events", Needs(Read)),
    ("GET", "/v1/jobs/{id}/series", Needs(Read)),
    ("GET", "/v1/jobs/{id}/artifact", Needs(Read)),
    ("GET", "/v1/jobs/{id}/artifacts", Needs(Read)),
    ("GET", "/v1/jobs/{id}/thumbnail", Needs(Read)),
    ("GET", "/v1/jobs/{id}/preview", Needs(Read)),
    ("GET", "/v1/jobs/{id}/export", Needs(Read)),
    ("GET", "/v1/artifacts/{sha256}", Needs(Read)),
    ("GET", "/v1/jobs/{id}/cameras", Needs(Read)),
    ("GET", "/v1/jobs/{id}/view", Needs(Read)),
    ("POST", "/v1/jobs/{id}/views", Needs(Read)),
    ("GET", "/v1/jobs/{id}/stream", Needs(Read)),
    ("GET", "/v1/jobs/{id}/animation", Needs(Read)),
    ("POST", "/v1/jobs/{id}/animation", Needs(Read)),
    ("GET", "/v1/jobs/{id}/report", Needs(Read)),
    ("GET", "/v1/jobs/{id}/viewer", Needs(Read)),
    ("GET", "/v1/jobs/{id}/shares", Needs(Read)),
    ("POST", "/v1/jobs/{id}/shares", Needs(JobsWrite)),
    ("DELETE", "/v1/jobs/{id}/shares/{share}", Needs(JobsWrite)),
    ("POST", "/v1/datasets", Needs(DatasetsWrite)),
    ("GET", "/v1/datasets", Needs(Read)),
    ("GET", "/v1/datasets/{id}", Needs(Read)),
    ("DELETE", "/v1/datasets/{id}", Needs(DatasetsWrite)),
    ("POST", "/v1/scenes", Needs(DatasetsWrite)),
    ("GET", "/v1/scenes", Needs(Read)),
    ("GET", "/v1/scenes/{id}", Needs(Read)),
    ("DELETE", "/v1/scenes/{id}", Needs(DatasetsWrite)),
    ("OPTIONS", "/v1/uploads", Needs(DatasetsWrite)),
    ("POST", "/v1/uploads", Needs(DatasetsWrite)),
    ("HEAD", "/v1/uploads/{id}", Needs(DatasetsWrite)),
    ("PATCH", "/v1/uploads/{id}", Needs(DatasetsWrite)),
    ("POST", "/v1/uploads/{id}", Needs(DatasetsWrite)),
    ("DELETE", "/v1/uploads/{id}", Needs(DatasetsWrite)),
    ("POST", "/v1/webhook-endpoints", Needs(JobsWrite)),
    ("GET", "/v1/webhook-endpoints", Needs(Read)),
    ("GET", "/v1/webhook-endpoints/{id}", Needs(Read)),
    ("DELETE", "/v1/webhook-endpoints/{id}", Needs(JobsWrite)),
    ("GET", "/v1/webhook-endpoints/{id}/deliveries", Needs(Read)),
    ("POST", "/v1/webhook-endpoints/{id}/deliveries/{delivery}/replay", Needs(JobsWrite)),
    ("GET", "/v1/usage", Needs(Read)),
    ("POST", "/v1/projects", Needs(Admin)),
    ("GET", "/v1/projects", Needs(Read)),
    ("GET", "/v1/projects/{id}", Needs(Read)),
    ("PATCH", "/v1/projects/{id}", Needs(Admin)),
    ("POST", "/v1/keys", Needs(Admin)),
    ("GET", "/v1/keys", Needs(Admin)),
    ("GET", "/v1/keys/{id}", Needs(Admin)),
    ("PATCH", "/v1/keys/{id}", Needs(Admin)),
    ("DELETE", "/v1/keys/{id}", Needs(Admin)),
    ("GET", "/", Optional(Read)),
    ("POST", "/session", Needs(Read)),
    ("DELETE", "/session", Needs(Read)),
    ("GET", "/healthz", Open),
    ("GET", "/readyz", Open),
    ("GET", "/metrics", Needs(Admin)),
    ("GET", "/version", Open),
    ("GET", "/openapi.yaml", Open),
    ("GET", "/viewer/worker.js", Open),
    ("GET", "/viewer/module.wasm", Open),
    ("GET", "/openapi.json", Open),
];

/// The access that an operation requires; `None` if there is no such operation. `HEAD` is `GET` unless it has a row of its own.
pub(crate) fn access(method: &str, route: &str) -> Option<Access> {
    let find = |method: &str| {
        let row = OPERATIONS.iter().find(|(known, path, _)| *known == method && *path == route);
        row.map(|(_, _, access)| *access)
    };
    find(method).or_else(|| (method == "HEAD").then(|| find("GET")).flatten())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use serde_json::{Value, json};

    use super::*;

    const METHODS: [&str; 8] = ["get", "put", "post", "delete", "options", "head", "patch", "trace"];

    fn contract() -> BTreeMap<(String, String), Value> {
        let document: Value = yaml_serde::from_str(include_str!("../../../openapi.yaml")).expect("YAML");
        let mut operations = BTreeMap::new();
        for (path, item) in document["paths"].as_object().expect("paths") {
            for method in METHODS {
                if let Some(operation) = item.get(method) {
                    operations.insert((method.to_uppercase(), path.clone()), operation.clone());
                }
            }
        }
        operations
    }

    #[test]
    fn every_operation_of_the_contract_has_a_row_and_every_row_an_operation() {
        let contract = contract();
        for (method, path) in contract.keys() {
            let row = OPERATIONS.iter().any(|(m, p, _)| m == method && p == path);
            assert!(row, "{method} {path} is in openapi.yaml; state its access in src/http/auth/scopes.rs");
        }
        for (index, (method, path, _)) in OPERATIONS.iter().enumerate() {
            let listed = contract.contains_key(&((*method).to_owned(), (*path).to_owned()));
            assert!(
                listed,
                "{method} {path} has a row in src/http/auth/scopes.rs and is not in openapi.yaml"
            );
            let again = OPERATIONS[..index].iter().any(|(m, p, _)| m == method && p == path);
            assert!(!again, "{method} {path} has two rows");
        }
    }

    #[test]
    fn the_contract_states_the_scope_and_the_refusals_of_every_operation() {
        for ((method, path), operation) in contract() {
            let place = format!("openapi.yaml: {method} {path}");
            let Some(access) = access(&method, &path) else {
                panic!("{place}: no row in src/http/auth/scopes.rs")
            };
            let statuses = ["401", "403", "429"];
            match access {
                Open => {
                    assert_eq!(operation["security"], json!([]), "{place}: should say 'security: []'");
                    for status in &statuses[..2] {
                        assert!(
                            operation["responses"].get(status).is_none(),
                            "{place}: cannot answer {status}"
                        );
                    }
                }
                Needs(scope) | Optional(scope) => {
                    let name = scope.name();
                    let mut expected = vec![json!({ "key": [name] })];
                    if access == Optional(scope) {
                        expected.insert(0, json!({}));
                    }
                    if matches!(&*method, "GET" | "HEAD") {
                        expected.push(json!({ "password": [name] }));
                    }
                    // A session cannot prolong itself.
                    if (&*method, &*path) != ("POST", "/session") {
                        expected.push(json!({ "session": [name] }));
                    }
                    assert_eq!(
                        operation["security"],
                        json!(expected),
                        "{place}: says other schemes than http/auth/mod.rs"
                    );
                    for status in statuses {
                        let listed = operation["responses"].get(status).is_some();
                        assert!(
                            listed,
                            "{place}: any operation that needs a key can answer {status}; list it"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn only_the_service_itself_is_open() {
        for (method, path, access) in OPERATIONS {
            assert!(
                matches!(access, Needs(_)) || !path.starts_with("/v1"),
                "{method} {path} is under /v1 and must need a key"
            );
        }
    }

    #[test]
    fn head_is_get_and_what_is_not_listed_has_no_access() {
        assert_eq!(access("HEAD", "/v1/jobs/{id}"), Some(Needs(Read)));
        assert_eq!(access("DELETE", "/v1/jobs"), None);
        assert_eq!(access("GET", "/v1/jobs/"), None);
    }
}
