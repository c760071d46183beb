//! JSON log lines with the causes of errors. `tracing-subscriber` writes only an error's own message; here each field that holds an
//! error gets a second field `<field>.sources` with the messages of its causes, outermost first, as in text lines.

use std::{error::Error, fmt};

use serde_json::{Map, Value};
use tracing::{
    Event, Subscriber,
    field::{Field, Visit},
};
use tracing_subscriber::{
    fmt::{FmtContext, FormatEvent, FormatFields, format::Writer},
    registry::LookupSpan,
};

/// Adds the causes to what the inner formatter writes, which is one JSON object a line.
pub(super) struct WithCauses<F>(pub(super) F);

impl<S, N, F> FormatEvent<S, N> for WithCauses<F>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
    F: FormatEvent<S, N>,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let mut causes = Causes::default();
        event.record(&mut causes);
        if causes.0.is_empty() {
            return self.0.format_event(context, writer, event);
        }
        let mut line = String::new();
        self.0.format_event(context, Writer::new(&mut line), event)?;
        match serde_json::from_str::<Map<String, Value>>(&line) {
            Ok(mut fields) => {
                fields.extend(causes.0);
                writeln!(writer, "{}", Value::Object(fields))
            }
            // Log the line without causes rather than not at all.
            Err(_) => writer.write_str(&line),
        }
    }
}

/// The causes of each error among an event's fields.
#[derive(Default)]
struct Causes(Map<String, Value>);

impl Visit for Causes {
    fn record_debug(&mut self, _: &Field, _: &dyn fmt::Debug) {}

    fn record_error(&mut self, field: &Field, error: &(dyn Error + 'static)) {
        let causes =
            std::iter::successors(error.source(), |cause: &&(dyn Error + 'static)| (*cause).source());
        let causes: Vec<Value> = causes.map(|cause| Value::String(cause.to_string())).collect();
        if !causes.is_empty() {
            self.0.insert(format!("{}.sources", field.name()), Value::Array(causes));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        io,
        sync::{Arc, Mutex},
    };

    use tcgs::store::{BlobError, StoreError};
    use tracing_subscriber::fmt::MakeWriter;

    use super::*;
    use crate::cli::logging::{Format, subscriber};

    #[derive(Clone, Default)]
    struct Lines(Arc<Mutex<Vec<u8>>>);

    impl io::Write for Lines {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.lock().expect("not poisoned").write(bytes)
        }
        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl<'a> MakeWriter<'a> for Lines {
        type Writer = Self;
        fn make_writer(&'a self) -> Self {
            self.clone()
        }
    }

    #[test]
    fn a_json_line_tells_every_cause_of_an_error() {
        let lines = Lines::default();
        tracing::subscriber::with_default(subscriber(Format::Json, "info", lines.clone()), || {
            let _span = tracing::info_span!("job", job = 7).entered();
            let full = io::Error::from(io::ErrorKind::StorageFull);
            let store = StoreError::Open { path: "tcgs.sqlite".into(), source: full.into() };
            tracing::error!(error = &store as &dyn Error, tries = 2, "no database: {store}");
            let error = BlobError::TooLarge { limit: 1 };
            tracing::warn!(error = &error as &dyn Error, "too large");
            tracing::info!("nothing is wrong");
        });
        let text = String::from_utf8(lines.0.lock().expect("not poisoned").clone()).expect("UTF-8");
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
        assert_eq!(lines.len(), 3, "{text}");
        assert_eq!(lines[0]["error"], "the database tcgs.sqlite does not open", "{text}");
        assert_eq!(lines[0]["error.sources"][1], "no storage space", "{text}");
        assert_eq!((&lines[0]["tries"], &lines[0]["span"]["job"]), (&2.into(), &7.into()), "{text}");
        assert_eq!(lines[0]["message"], "no database: the database tcgs.sqlite does not open");
        assert_eq!(
            (&lines[1]["message"], lines[1].get("error.sources")),
            (&"too large".into(), None),
            "{text}"
        );
        assert_eq!(lines[2]["message"], "nothing is wrong");
    }
}
