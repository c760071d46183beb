//! Metrics of the process itself, which `/metrics` shows with those of the database and the disk.
//!
//! Every label has a bounded set of values: a method is a known one, a path is its route's template, a cause is a problem's type.
//! Nothing that a client invents becomes a series.

use std::{fmt, sync::Arc, time::Duration};

use axum::http::Method;
use prometheus_client::{
    encoding::EncodeLabelSet,
    metrics::{counter::Counter, family::Family, gauge::Gauge, histogram::Histogram, info::Info},
    registry::{Metric, Registry},
};

/// Upper ends of the buckets of requests, in seconds.
const REQUEST_SECONDS: [f64; 11] = [0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0];
/// Upper ends of the buckets of renders, in seconds: a software adapter takes long.
const RENDER_SECONDS: [f64; 11] = [0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0];
/// Methods that have series of their own.
const METHODS: [&str; 7] = ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"];

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RequestLabels {
    method: &'static str,
    route: String,
    status: u16,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RouteLabel {
    route: String,
}

fn shown(route: Option<&str>) -> String {
    route.unwrap_or("unmatched").to_owned()
}

type Requests = Family<RequestLabels, Histogram, fn() -> Histogram>;

/// The process's own counts; clones share them.
#[derive(Clone)]
pub(super) struct Meters(Arc<Counts>);

struct Counts {
    registry: Registry,
    requests: Requests,
    active_requests: Gauge,
    connections: Gauge,
    connections_refused: Counter,
    body_bytes: Family<RouteLabel, Counter>,
    renders: Histogram,
    event_streams: Gauge,
}

impl fmt::Debug for Meters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Meters").finish_non_exhaustive()
    }
}

/// Something that is counted while it is held.
#[derive(Debug)]
pub(super) struct GaugeGuard(Gauge);

impl GaugeGuard {
    fn one_of(gauge: &Gauge) -> Self {
        gauge.inc();
        Self(gauge.clone())
    }
}

impl Drop for GaugeGuard {
    fn drop(&mut self) {
        self.0.dec();
    }
}

impl Default for Meters {
    fn default() -> Self {
        let mut registry = Registry::default();
        let all = &mut registry;
        let requests = Requests::new_with_constructor(|| Histogram::new(REQUEST_SECONDS));
        let requests =
            named(all, "http_request_duration_seconds", "Time to the first byte of the response", requests);
        let active_requests =
            named(all, "http_active_requests", "Requests without a response yet", Gauge::default());
        let connections = named(all, "http_connections", "Open connections", Gauge::default());
        let refused = "Connections closed because their address had too many";
        let connections_refused = named(all, "http_connections_refused", refused, Counter::default());
        let received = "Bytes of request bodies received, datasets among them";
        let body_bytes = named(all, "http_request_body_bytes", received, Family::default());
        let renders = Histogram::new(RENDER_SECONDS);
        let renders = named(all, "tcgs_render_seconds", "Time that the renderer took for a picture", renders);
        let event_streams = named(all, "tcgs_event_streams", "Open event streams", Gauge::default());
        let build = Info::new(vec![("version", env!("CARGO_PKG_VERSION"))]);
        registry.register("tcgs_build", "Version of the program", build);
        Self(Arc::new(Counts {
            registry,
            requests,
            active_requests,
            connections,
            connections_refused,
            body_bytes,
            renders,
            event_streams,
        }))
    }
}

/// The metric, which the registry has under this name from now on.
fn named<M: Metric + Clone>(registry: &mut Registry, name: &str, help: &str, metric: M) -> M {
    registry.register(name, help, metric.clone());
    metric
}

impl Meters {
    /// A request has come; hold it until its answer begins.
    pub(super) fn request_begun(&self) -> GaugeGuard {
        GaugeGuard::one_of(&self.0.active_requests)
    }

    /// A request's answer has begun; `route` is a template and none for paths that have none.
    pub(super) fn request_answered(
        &self,
        method: &Method,
        route: Option<&str>,
        status: u16,
        after: Duration,
    ) {
        let known = METHODS.into_iter().find(|known| *known == method.as_str());
        let labels = RequestLabels { method: known.unwrap_or("other"), route: shown(route), status };
        self.0.requests.get_or_create(&labels).observe(after.as_secs_f64());
    }

    /// A connection is served; hold it until it ends.
    pub(super) fn connection_opened(&self) -> GaugeGuard {
        GaugeGuard::one_of(&self.0.connections)
    }

    /// A connection was closed without being served.
    pub(super) fn connection_refused(&self) {
        self.0.connections_refused.inc();
    }

    /// The count of bytes that come in bodies of requests for a route.
    pub(super) fn body_bytes(&self, route: Option<&str>) -> Counter {
        let label = RouteLabel { route: shown(route) };
        self.0.body_bytes.get_or_create_owned(&label)
    }

    /// A picture took the renderer this long.
    pub(super) fn rendered(&self, time: Duration) {
        self.0.renders.observe(time.as_secs_f64());
    }

    /// An event stream has begun; hold it until it ends.
    pub(super) fn stream_opened(&self) -> GaugeGuard {
        GaugeGuard::one_of(&self.0.event_streams)
    }

    /// Every metric of the process.
    pub(super) fn registry(&self) -> &Registry {
        &self.0.registry
    }
}

#[cfg(test)]
mod tests {
    use prometheus_client::encoding::text::encode;

    use super::*;

    fn text(meters: &Meters) -> String {
        let mut text = String::new();
        encode(&mut text, meters.registry()).expect("encodes");
        text
    }

    #[test]
    fn what_is_held_is_counted_until_it_is_let_go() {
        let meters = Meters::default();
        let held = (meters.request_begun(), meters.connection_opened(), meters.stream_opened());
        let names = ["http_active_requests", "http_connections", "tcgs_event_streams"];
        for name in names {
            assert!(text(&meters).contains(&format!("\n{name} 1\n")), "{name}");
        }
        drop(held);
        for name in names {
            assert!(text(&meters).contains(&format!("\n{name} 0\n")), "{name}");
        }
    }

    #[test]
    fn invented_methods_and_paths_share_one_series() {
        let meters = Meters::default();
        for invented in ["BREW", "WHEN", "x"] {
            let method = Method::from_bytes(invented.as_bytes()).expect("a token");
            meters.request_answered(&method, None, 404, Duration::from_millis(3));
        }
        let text = text(&meters);
        let count =
            "http_request_duration_seconds_count{method=\"other\",route=\"unmatched\",status=\"404\"} 3\n";
        assert!(text.contains(count), "{text}");
    }
}
