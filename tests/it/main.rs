//! All integration tests in one binary: one link, one GPU device per process. The folders are those of `src`; `system` has the
//! tests of the whole program, `readers` the fuzz targets of what reads untrusted input, `documents` the tests that hold documents to
//! the program.

mod accuracy;
mod cli;
mod documents;
mod eval;
mod export;
mod http;
mod ingest;
mod layers;
mod readers;
mod sample;
mod store;
mod support;
mod system;
mod train;
mod viewers;
mod worker;
