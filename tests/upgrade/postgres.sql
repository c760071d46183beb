--
-- PostgreSQL database dump
--

\restrict 4Qziv2ybIz41Os9kSiqdp3JcM2vYynazj5YdHyB9Q01XgfojPsyLNTePQm7nR9T

-- Dumped from database version 15.18 (Debian 15.18-0+deb12u1)
-- Dumped by pg_dump version 15.18 (Debian 15.18-0+deb12u1)

SET statement_timeout = 0;
SET lock_timeout = 0;
SET idle_in_transaction_session_timeout = 0;
SET client_encoding = 'UTF8';
SET standard_conforming_strings = on;
SELECT pg_catalog.set_config('search_path', '', false);
SET check_function_bodies = false;
SET xmloption = content;
SET client_min_messages = warning;
SET row_security = off;

--
-- Name: attempts_added(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.attempts_added() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO counter_changes (name, value) VALUES ('claims', 1);
    UPDATE project_totals SET last_claim = nextval('claim_numbers')
    WHERE project = (SELECT project FROM jobs WHERE id = NEW.job_id);
    RETURN NULL;
END $$;


--
-- Name: attempts_ended(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.attempts_ended() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO counter_changes (name, label, cause, value)
    VALUES ('attempts_ended', NEW.outcome, COALESCE(CAST(NEW.cause AS jsonb) ->> 'type', ''), 1);
    UPDATE project_totals SET worker_micros = worker_micros + GREATEST(0, NEW.ended_at - NEW.started_at)
    WHERE project = (SELECT project FROM jobs WHERE id = NEW.job_id);
    RETURN NULL;
END $$;


--
-- Name: blobs_changed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.blobs_changed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    IF TG_OP = 'INSERT' THEN
        INSERT INTO total_changes (name, value) VALUES ('blobs', 1), ('blob_bytes', NEW.bytes);
    ELSE
        INSERT INTO total_changes (name, value) VALUES ('blobs', -1), ('blob_bytes', -OLD.bytes);
    END IF;
    RETURN NULL;
END $$;


--
-- Name: count_job(text, text, bigint); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.count_job(of_project text, of_state text, more bigint) RETURNS void
    LANGUAGE plpgsql
    AS $$
BEGIN
    UPDATE project_totals SET
        queued_jobs = queued_jobs + CASE of_state WHEN 'queued' THEN more ELSE 0 END,
        running_jobs = running_jobs + CASE of_state WHEN 'running' THEN more ELSE 0 END,
        succeeded_jobs = succeeded_jobs + CASE of_state WHEN 'succeeded' THEN more ELSE 0 END,
        failed_jobs = failed_jobs + CASE of_state WHEN 'failed' THEN more ELSE 0 END,
        cancelled_jobs = cancelled_jobs + CASE of_state WHEN 'cancelled' THEN more ELSE 0 END
    WHERE project = of_project;
END $$;


--
-- Name: deliveries_changed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.deliveries_changed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    IF TG_OP <> 'INSERT' THEN
        INSERT INTO total_changes (name, label, value) VALUES ('deliveries', OLD.state, -1);
    END IF;
    IF TG_OP <> 'DELETE' THEN
        INSERT INTO total_changes (name, label, value) VALUES ('deliveries', NEW.state, 1);
    END IF;
    RETURN NULL;
END $$;


--
-- Name: files_changed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.files_changed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    IF TG_OP = 'INSERT' THEN
        PERFORM use_blob(project, NEW.digest, TG_ARGV[0]) FROM jobs WHERE id = NEW.job_id;
    ELSE
        PERFORM release_blob(project, OLD.digest) FROM jobs WHERE id = OLD.job_id;
    END IF;
    RETURN NULL;
END $$;


--
-- Name: fold_changes(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.fold_changes() RETURNS void
    LANGUAGE plpgsql
    AS $$
BEGIN
    IF NOT pg_try_advisory_xact_lock(7203481) THEN
        RETURN;
    END IF;
    WITH gone AS (DELETE FROM total_changes RETURNING name, label, value)
    INSERT INTO totals AS kept (name, label, value) SELECT name, label, SUM(value) FROM gone GROUP BY name, label
    ON CONFLICT (name, label) DO UPDATE SET value = kept.value + excluded.value;
    WITH gone AS (DELETE FROM counter_changes RETURNING name, label, cause, value)
    INSERT INTO counters AS kept (name, label, cause, value)
    SELECT name, label, cause, SUM(value) FROM gone GROUP BY name, label, cause
    ON CONFLICT (name, label, cause) DO UPDATE SET value = kept.value + excluded.value;
END $$;


--
-- Name: jobs_added(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.jobs_added() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    PERFORM use_blob(NEW.project, NEW.dataset, 'dataset');
    PERFORM count_job(NEW.project, NEW.state, 1);
    RETURN NULL;
END $$;


--
-- Name: jobs_changed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.jobs_changed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    PERFORM count_job(NEW.project, OLD.state, -1);
    PERFORM count_job(NEW.project, NEW.state, 1);
    UPDATE project_totals SET last_claim = 0 WHERE project = NEW.project AND queued_jobs + running_jobs = 0;
    RETURN NULL;
END $$;


--
-- Name: jobs_measured(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.jobs_measured() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO counter_changes (name, label, value)
    SELECT 'phase_seconds', phases.name, seconds
    FROM (VALUES ('ingest'), ('train'), ('encode'), ('decode')) AS phases (name)
    CROSS JOIN LATERAL (
        SELECT CAST(CAST(NEW.metrics AS jsonb) -> 'seconds' ->> phases.name AS double precision)) AS found (seconds)
    WHERE seconds IS NOT NULL;
    RETURN NULL;
END $$;


--
-- Name: jobs_removed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.jobs_removed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    PERFORM release_blob(OLD.project, OLD.dataset);
    PERFORM count_job(OLD.project, OLD.state, -1);
    RETURN NULL;
END $$;


--
-- Name: jobs_removing(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.jobs_removing() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    DELETE FROM artifacts WHERE job_id = OLD.id;
    DELETE FROM exports WHERE job_id = OLD.id;
    RETURN OLD;
END $$;


--
-- Name: project_blobs_changed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.project_blobs_changed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
DECLARE
    changed project_blobs;
    size BIGINT;
BEGIN
    IF TG_OP = 'INSERT' THEN changed := NEW; ELSE changed := OLD; END IF;
    SELECT bytes INTO size FROM blobs WHERE digest = changed.digest;
    IF TG_OP = 'DELETE' THEN size := -size; END IF;
    UPDATE project_totals SET
        dataset_bytes = dataset_bytes + CASE changed.kind WHEN 'dataset' THEN size ELSE 0 END,
        artifact_bytes = artifact_bytes + CASE changed.kind WHEN 'artifact' THEN size ELSE 0 END,
        export_bytes = export_bytes + CASE changed.kind WHEN 'export' THEN size ELSE 0 END
    WHERE project = changed.project;
    RETURN NULL;
END $$;


--
-- Name: projects_added(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.projects_added() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO project_totals (project) VALUES (NEW.id);
    RETURN NULL;
END $$;


--
-- Name: release_blob(text, text); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.release_blob(of_project text, of_blob text) RETURNS void
    LANGUAGE plpgsql
    AS $$
BEGIN
    UPDATE project_blobs SET uses = uses - 1 WHERE project = of_project AND digest = of_blob;
    DELETE FROM project_blobs WHERE project = of_project AND digest = of_blob AND uses = 0;
END $$;


--
-- Name: scenes_changed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.scenes_changed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    IF TG_OP = 'INSERT' THEN
        PERFORM use_blob(NEW.project, NEW.dataset, 'dataset');
    ELSE
        PERFORM release_blob(OLD.project, OLD.dataset);
    END IF;
    RETURN NULL;
END $$;


--
-- Name: tell(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.tell() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
BEGIN
    PERFORM pg_notify(TG_ARGV[0], '');
    RETURN NULL;
END $$;


--
-- Name: uploads_changed(); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.uploads_changed() RETURNS trigger
    LANGUAGE plpgsql
    AS $$
DECLARE
    of_project TEXT;
    reserved BIGINT := 0;
BEGIN
    IF TG_OP <> 'INSERT' AND OLD.ended_at IS NULL THEN
        reserved := -OLD.length;
        of_project := OLD.project;
    END IF;
    IF TG_OP <> 'DELETE' AND NEW.ended_at IS NULL THEN
        reserved := reserved + NEW.length;
        of_project := NEW.project;
    END IF;
    IF reserved <> 0 THEN
        UPDATE project_totals SET reserved_bytes = reserved_bytes + reserved WHERE project = of_project;
    END IF;
    RETURN NULL;
END $$;


--
-- Name: use_blob(text, text, text); Type: FUNCTION; Schema: public; Owner: -
--

CREATE FUNCTION public.use_blob(of_project text, of_blob text, of_kind text) RETURNS void
    LANGUAGE plpgsql
    AS $$
BEGIN
    INSERT INTO project_blobs AS kept (project, digest, uses, kind) VALUES (of_project, of_blob, 1, of_kind)
    ON CONFLICT (project, digest) DO UPDATE SET uses = kept.uses + 1;
END $$;


SET default_tablespace = '';

SET default_table_access_method = heap;

--
-- Name: _sqlx_migrations; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public._sqlx_migrations (
    version bigint NOT NULL,
    description text NOT NULL,
    installed_on timestamp with time zone DEFAULT now() NOT NULL,
    success boolean NOT NULL,
    checksum bytea NOT NULL,
    execution_time bigint NOT NULL
);


--
-- Name: artifacts; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.artifacts (
    job_id text NOT NULL COLLATE pg_catalog."C",
    kind text NOT NULL COLLATE pg_catalog."C",
    place bigint NOT NULL,
    lambda double precision,
    digest text NOT NULL COLLATE pg_catalog."C",
    attempt bigint NOT NULL,
    CONSTRAINT artifacts_kind_check CHECK ((kind = ANY (ARRAY['tcgs'::text, 'safetensors'::text, 'ply'::text, 'cameras'::text, 'held_out'::text]))),
    CONSTRAINT artifacts_place_check CHECK ((place >= 0))
);


--
-- Name: attempts; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.attempts (
    job_id text NOT NULL COLLATE pg_catalog."C",
    number bigint NOT NULL,
    worker text NOT NULL,
    started_at bigint NOT NULL,
    ended_at bigint,
    outcome text,
    cause text,
    CONSTRAINT attempts_check CHECK (((ended_at IS NULL) = (outcome IS NULL))),
    CONSTRAINT attempts_outcome_check CHECK ((outcome = ANY (ARRAY['succeeded'::text, 'failed'::text, 'retried'::text, 'cancelled'::text, 'released'::text, 'lost'::text])))
);


--
-- Name: blob_place; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.blob_place (
    id text NOT NULL COLLATE pg_catalog."C",
    place text COLLATE pg_catalog."C",
    CONSTRAINT blob_place_place_check CHECK ((place = ANY (ARRAY['folder'::text, 'bucket'::text])))
);


--
-- Name: blobs; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.blobs (
    digest text NOT NULL COLLATE pg_catalog."C",
    bytes bigint NOT NULL,
    created_at bigint NOT NULL,
    CONSTRAINT blobs_bytes_check CHECK ((bytes >= 0))
);


--
-- Name: claim_numbers; Type: SEQUENCE; Schema: public; Owner: -
--

CREATE SEQUENCE public.claim_numbers
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;


--
-- Name: counter_changes; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.counter_changes (
    name text NOT NULL COLLATE pg_catalog."C",
    label text DEFAULT ''::text NOT NULL COLLATE pg_catalog."C",
    cause text DEFAULT ''::text NOT NULL COLLATE pg_catalog."C",
    value double precision NOT NULL
);


--
-- Name: counters; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.counters (
    name text NOT NULL COLLATE pg_catalog."C",
    label text DEFAULT ''::text NOT NULL COLLATE pg_catalog."C",
    cause text DEFAULT ''::text NOT NULL COLLATE pg_catalog."C",
    value double precision NOT NULL
);


--
-- Name: events; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.events (
    job_id text NOT NULL COLLATE pg_catalog."C",
    seq bigint NOT NULL,
    at bigint NOT NULL,
    kind text NOT NULL,
    attempt bigint NOT NULL,
    data text NOT NULL,
    CONSTRAINT events_seq_check CHECK ((seq > 0))
);


--
-- Name: exports; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.exports (
    job_id text NOT NULL COLLATE pg_catalog."C",
    source text NOT NULL COLLATE pg_catalog."C",
    format text NOT NULL COLLATE pg_catalog."C",
    digest text NOT NULL COLLATE pg_catalog."C",
    gaussians bigint NOT NULL,
    sh_degree bigint NOT NULL,
    created_at bigint NOT NULL,
    likeness_psnr double precision,
    likeness_views bigint,
    CONSTRAINT exports_check CHECK (((likeness_psnr IS NULL) = (likeness_views IS NULL))),
    CONSTRAINT exports_format_check CHECK ((format = ANY (ARRAY['ply'::text, 'spz'::text, 'spz3'::text]))),
    CONSTRAINT exports_gaussians_check CHECK ((gaussians >= 0)),
    CONSTRAINT exports_likeness_views_check CHECK ((likeness_views > 0)),
    CONSTRAINT exports_sh_degree_check CHECK (((sh_degree >= 0) AND (sh_degree <= 3)))
);


--
-- Name: idempotency; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.idempotency (
    project text NOT NULL COLLATE pg_catalog."C",
    key text NOT NULL COLLATE pg_catalog."C",
    fingerprint text NOT NULL,
    status bigint NOT NULL,
    resource text NOT NULL,
    created_at bigint NOT NULL
);


--
-- Name: jobs; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.jobs (
    id text NOT NULL COLLATE pg_catalog."C",
    project text NOT NULL COLLATE pg_catalog."C",
    owner text COLLATE pg_catalog."C",
    name text COLLATE pg_catalog."C",
    metadata text DEFAULT '{}'::text NOT NULL,
    scene text COLLATE pg_catalog."C",
    retry_of text COLLATE pg_catalog."C",
    from_checkpoint boolean DEFAULT false NOT NULL,
    dataset text NOT NULL COLLATE pg_catalog."C",
    options text NOT NULL,
    state text NOT NULL COLLATE pg_catalog."C",
    phase text NOT NULL,
    progress text NOT NULL,
    metrics text,
    error text,
    priority bigint NOT NULL,
    run_after bigint NOT NULL,
    waits_since bigint DEFAULT 0 NOT NULL,
    deadline_at bigint,
    attempt bigint DEFAULT 0 NOT NULL,
    charged bigint DEFAULT 0 NOT NULL,
    max_attempts bigint NOT NULL,
    silent_deaths bigint DEFAULT 0 NOT NULL,
    setbacks bigint DEFAULT 0 NOT NULL,
    checkpoint_step bigint DEFAULT 0 NOT NULL,
    setback_step bigint DEFAULT 0 NOT NULL,
    lease_owner text,
    lease_until bigint,
    cancel_requested_at bigint,
    progress_event_at bigint,
    last_seq bigint DEFAULT 0 NOT NULL,
    version bigint DEFAULT 1 NOT NULL,
    created_at bigint NOT NULL,
    started_at bigint,
    finished_at bigint,
    CONSTRAINT jobs_check CHECK (((state = 'running'::text) = (lease_owner IS NOT NULL))),
    CONSTRAINT jobs_check1 CHECK (((state = 'running'::text) = (lease_until IS NOT NULL))),
    CONSTRAINT jobs_check2 CHECK (((state = ANY (ARRAY['succeeded'::text, 'failed'::text, 'cancelled'::text])) = (finished_at IS NOT NULL))),
    CONSTRAINT jobs_checkpoint_step_check CHECK ((checkpoint_step >= 0)),
    CONSTRAINT jobs_max_attempts_check CHECK ((max_attempts > 0)),
    CONSTRAINT jobs_setback_step_check CHECK ((setback_step >= 0)),
    CONSTRAINT jobs_setbacks_check CHECK ((setbacks >= 0)),
    CONSTRAINT jobs_state_check CHECK ((state = ANY (ARRAY['queued'::text, 'running'::text, 'succeeded'::text, 'failed'::text, 'cancelled'::text])))
);


--
-- Name: keys; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.keys (
    id text NOT NULL COLLATE pg_catalog."C",
    project text NOT NULL COLLATE pg_catalog."C",
    name text NOT NULL,
    prefix text NOT NULL,
    hash text NOT NULL COLLATE pg_catalog."C",
    scopes text NOT NULL,
    requests_per_minute bigint,
    created_at bigint NOT NULL,
    last_used_at bigint,
    expires_at bigint,
    revoked_at bigint,
    CONSTRAINT keys_requests_per_minute_check CHECK ((requests_per_minute > 0))
);


--
-- Name: project_blobs; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.project_blobs (
    project text NOT NULL COLLATE pg_catalog."C",
    digest text NOT NULL COLLATE pg_catalog."C",
    uses bigint NOT NULL,
    kind text NOT NULL,
    CONSTRAINT project_blobs_kind_check CHECK ((kind = ANY (ARRAY['dataset'::text, 'artifact'::text, 'export'::text])))
);


--
-- Name: project_totals; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.project_totals (
    project text NOT NULL COLLATE pg_catalog."C",
    queued_jobs bigint DEFAULT 0 NOT NULL,
    running_jobs bigint DEFAULT 0 NOT NULL,
    succeeded_jobs bigint DEFAULT 0 NOT NULL,
    failed_jobs bigint DEFAULT 0 NOT NULL,
    cancelled_jobs bigint DEFAULT 0 NOT NULL,
    dataset_bytes bigint DEFAULT 0 NOT NULL,
    artifact_bytes bigint DEFAULT 0 NOT NULL,
    export_bytes bigint DEFAULT 0 NOT NULL,
    reserved_bytes bigint DEFAULT 0 NOT NULL,
    worker_micros bigint DEFAULT 0 NOT NULL,
    last_claim bigint DEFAULT 0 NOT NULL
)
WITH (fillfactor='50');


--
-- Name: projects; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.projects (
    id text NOT NULL COLLATE pg_catalog."C",
    name text NOT NULL,
    max_bytes bigint,
    max_active_jobs bigint,
    max_running_jobs bigint,
    max_priority bigint,
    version bigint DEFAULT 1 NOT NULL,
    created_at bigint NOT NULL,
    CONSTRAINT projects_max_active_jobs_check CHECK ((max_active_jobs >= 0)),
    CONSTRAINT projects_max_bytes_check CHECK ((max_bytes >= 0)),
    CONSTRAINT projects_max_priority_check CHECK (((max_priority >= '-100'::integer) AND (max_priority <= 100))),
    CONSTRAINT projects_max_running_jobs_check CHECK ((max_running_jobs >= 0))
);


--
-- Name: publications; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.publications (
    id bigint NOT NULL,
    digest text NOT NULL COLLATE pg_catalog."C",
    bytes bigint NOT NULL,
    published_at bigint NOT NULL,
    removing_since bigint,
    CONSTRAINT publications_bytes_check CHECK ((bytes >= 0))
);


--
-- Name: publications_id_seq; Type: SEQUENCE; Schema: public; Owner: -
--

ALTER TABLE public.publications ALTER COLUMN id ADD GENERATED ALWAYS AS IDENTITY (
    SEQUENCE NAME public.publications_id_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1
);


--
-- Name: scenes; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.scenes (
    id text NOT NULL COLLATE pg_catalog."C",
    project text NOT NULL COLLATE pg_catalog."C",
    dataset text NOT NULL COLLATE pg_catalog."C",
    name text,
    summary text NOT NULL,
    version bigint DEFAULT 1 NOT NULL,
    created_at bigint NOT NULL
);


--
-- Name: series; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.series (
    job_id text NOT NULL COLLATE pg_catalog."C",
    bucket bigint NOT NULL,
    attempt bigint NOT NULL,
    step bigint NOT NULL,
    seconds double precision NOT NULL,
    loss double precision,
    psnr double precision,
    ssim double precision,
    anchors bigint NOT NULL,
    gaussians bigint NOT NULL,
    bytes bigint,
    CONSTRAINT series_bucket_check CHECK (((bucket >= 0) AND (bucket <= 999)))
);


--
-- Name: total_changes; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.total_changes (
    name text NOT NULL COLLATE pg_catalog."C",
    label text DEFAULT ''::text NOT NULL COLLATE pg_catalog."C",
    value bigint NOT NULL
);


--
-- Name: totals; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.totals (
    name text NOT NULL COLLATE pg_catalog."C",
    label text DEFAULT ''::text NOT NULL COLLATE pg_catalog."C",
    value bigint NOT NULL
);


--
-- Name: upload_parts; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.upload_parts (
    upload text NOT NULL COLLATE pg_catalog."C",
    start bigint NOT NULL,
    name text NOT NULL COLLATE pg_catalog."C"
);


--
-- Name: uploads; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.uploads (
    id text NOT NULL COLLATE pg_catalog."C",
    project text NOT NULL COLLATE pg_catalog."C",
    length bigint NOT NULL,
    received bigint DEFAULT 0 NOT NULL,
    metadata text,
    scene text COLLATE pg_catalog."C",
    created_at bigint NOT NULL,
    expires_at bigint NOT NULL,
    ended_at bigint,
    writer bigint DEFAULT 0 NOT NULL,
    writer_until bigint,
    CONSTRAINT uploads_check CHECK (((received >= 0) AND (received <= length))),
    CONSTRAINT uploads_length_check CHECK (((length >= 0) AND (length <= '1125899906842624'::bigint)))
);


--
-- Name: viewers; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.viewers (
    url text NOT NULL COLLATE pg_catalog."C",
    version text NOT NULL COLLATE pg_catalog."C",
    identity text NOT NULL COLLATE pg_catalog."C",
    token text NOT NULL COLLATE pg_catalog."C",
    seen_at bigint NOT NULL
);


--
-- Name: webhook_deliveries; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.webhook_deliveries (
    seq bigint NOT NULL,
    id text NOT NULL COLLATE pg_catalog."C",
    endpoint text NOT NULL COLLATE pg_catalog."C",
    job text NOT NULL,
    event text NOT NULL,
    body text NOT NULL,
    state text NOT NULL,
    attempts bigint DEFAULT 0 NOT NULL,
    tries bigint DEFAULT 0 NOT NULL,
    due_at bigint,
    lease_until bigint,
    created_at bigint NOT NULL,
    attempted_at bigint,
    delivered_at bigint,
    answer_status bigint,
    answer_fault text,
    CONSTRAINT webhook_deliveries_check CHECK (((state = 'pending'::text) = (due_at IS NOT NULL))),
    CONSTRAINT webhook_deliveries_check1 CHECK (((state = 'pending'::text) OR (lease_until IS NULL))),
    CONSTRAINT webhook_deliveries_check2 CHECK (((state = 'delivered'::text) = (delivered_at IS NOT NULL))),
    CONSTRAINT webhook_deliveries_state_check CHECK ((state = ANY (ARRAY['pending'::text, 'delivered'::text, 'failed'::text])))
);


--
-- Name: webhook_deliveries_seq_seq; Type: SEQUENCE; Schema: public; Owner: -
--

ALTER TABLE public.webhook_deliveries ALTER COLUMN seq ADD GENERATED ALWAYS AS IDENTITY (
    SEQUENCE NAME public.webhook_deliveries_seq_seq
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1
);


--
-- Name: webhook_endpoints; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.webhook_endpoints (
    id text NOT NULL COLLATE pg_catalog."C",
    project text NOT NULL COLLATE pg_catalog."C",
    url text NOT NULL,
    events text NOT NULL,
    description text,
    secret text NOT NULL,
    created_at bigint NOT NULL,
    disabled_at bigint
);


--
-- Name: write_probe; Type: TABLE; Schema: public; Owner: -
--

CREATE TABLE public.write_probe (
    id bigint NOT NULL,
    at bigint NOT NULL,
    CONSTRAINT write_probe_id_check CHECK ((id = 1))
);


--
-- Data for Name: _sqlx_migrations; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public._sqlx_migrations VALUES (1, 'schema', '2026-11-27 22:44:23.052915+00', true, '\xdf44c65d81910eb09d8717a8c32ff6323d1458bc63ed903a4d7c2bee5882b834a738691bd1779492ca8343ce0bc6ccf7', 153973911);
INSERT INTO public._sqlx_migrations VALUES (2, 'publications', '2026-11-27 22:44:23.208329+00', true, '\x4e6c8ef62d6e56a998d730a56b2d320f917a353ab5520c76e7511f2b897e2303ac3464f9f37d38e7b57620543a4d3b15', 18603414);
INSERT INTO public._sqlx_migrations VALUES (3, 'viewers', '2026-11-27 22:44:23.227554+00', true, '\xd847f5a8ada30246995cb4184c7205b4477ab0eb03380d0a3b9fc0b79f7c64daf7ceacb941c14b8442cf2a1a684afbbd', 4796805);


--
-- Data for Name: artifacts; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.artifacts VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 'tcgs', 0, NULL, '5cdb9f96a6c7ed0f51ae380a32fc9dbad12b80209af4a1178434aeae174e7e3e', 1);
INSERT INTO public.artifacts VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 'cameras', 0, NULL, '2519c7c1690cb177896bc440379f9d60755d43894cd0cd653869c06a7ff36c4f', 1);
INSERT INTO public.artifacts VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 'held_out', 0, NULL, '94d71b0949a8c6a79d03aa1f6cf0a4e86e62946e8a58548e8f98cb2745f87a7c', 1);


--
-- Data for Name: attempts; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.attempts VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 1, 'worker-6356-01a21f2e634e7211a82a4c71dfbf5fde', 1795819463562927, 1795819468351758, 'succeeded', NULL);
INSERT INTO public.attempts VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 1, 'worker-6356-01a21f2e634e7211a82a4c71dfbf5fde', 1795819468473360, NULL, NULL, NULL);


--
-- Data for Name: blob_place; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.blob_place VALUES ('3a1d14ac3afb4fce8a2b3fb465307301', 'folder');


--
-- Data for Name: blobs; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.blobs VALUES ('399b53f05096298a3c0247d3125b3993ff6a9b59ce8483b6f4c0c02418e0689a', 170694, 1795819463531052);
INSERT INTO public.blobs VALUES ('5cdb9f96a6c7ed0f51ae380a32fc9dbad12b80209af4a1178434aeae174e7e3e', 8315, 1795819468351758);
INSERT INTO public.blobs VALUES ('2519c7c1690cb177896bc440379f9d60755d43894cd0cd653869c06a7ff36c4f', 19331, 1795819468351758);
INSERT INTO public.blobs VALUES ('94d71b0949a8c6a79d03aa1f6cf0a4e86e62946e8a58548e8f98cb2745f87a7c', 49633, 1795819468351758);


--
-- Data for Name: counter_changes; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.counter_changes VALUES ('claims', '', '', 1);
INSERT INTO public.counter_changes VALUES ('attempts_ended', 'succeeded', '', 1);
INSERT INTO public.counter_changes VALUES ('phase_seconds', 'ingest', '', 0.129711095);
INSERT INTO public.counter_changes VALUES ('phase_seconds', 'train', '', 1.958167463);
INSERT INTO public.counter_changes VALUES ('phase_seconds', 'encode', '', 0.398719842);
INSERT INTO public.counter_changes VALUES ('phase_seconds', 'decode', '', 0.008150794);
INSERT INTO public.counter_changes VALUES ('claims', '', '', 1);


--
-- Data for Name: counters; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: events; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 1, 1795819463531052, 'state', 0, '{"state":"queued"}');
INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 2, 1795819463562927, 'state', 1, '{"state":"running"}');
INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 3, 1795819463562927, 'phase', 1, '{"phase":"ingest"}');
INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 4, 1795819464600904, 'phase', 1, '{"phase":"train"}');
INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 5, 1795819464600904, 'progress', 1, '{"step":0,"total":20,"elapsed_seconds":0.129714091,"eta_seconds":null,"steps_per_second":null,"anchors":0,"gaussians":0,"loss":null,"psnr":null,"ssim":null,"bytes":null}');
INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 6, 1795819466596695, 'phase', 1, '{"phase":"evaluate"}');
INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 7, 1795819468335305, 'phase', 1, '{"phase":"publish"}');
INSERT INTO public.events VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 8, 1795819468351758, 'state', 1, '{"state":"succeeded"}');
INSERT INTO public.events VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 1, 1795819468446720, 'state', 0, '{"state":"queued"}');
INSERT INTO public.events VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 2, 1795819468473360, 'state', 1, '{"state":"running"}');
INSERT INTO public.events VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 3, 1795819468473360, 'phase', 1, '{"phase":"ingest"}');
INSERT INTO public.events VALUES ('01a21f2e-76e3-7168-8f11-0fe19842fff7', 1, 1795819468520783, 'state', 0, '{"state":"queued"}');
INSERT INTO public.events VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 4, 1795819469504258, 'phase', 1, '{"phase":"train"}');
INSERT INTO public.events VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 5, 1795819469504258, 'progress', 1, '{"step":50,"total":200,"elapsed_seconds":0.92129008,"eta_seconds":2.430977877,"steps_per_second":51.34145255278636,"anchors":1073,"gaussians":1665,"loss":0.30041115371333743,"psnr":11.688709836059331,"ssim":0.41401055077314386,"bytes":null}');


--
-- Data for Name: exports; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: idempotency; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.idempotency VALUES ('00000000-0000-0000-0000-000000000000', '01a21f2e-634a-712e-a154-19c2fd1a2f75', '33bf07f14d8f9fa28cefd04b6589061414f389a4eab83ae00a1952b277b10122', 201, '01a21f2e-6362-79b7-815f-ad03e8eb59d5', 1795819463531052);
INSERT INTO public.idempotency VALUES ('00000000-0000-0000-0000-000000000000', '01a21f2e-768d-7464-93eb-9aae92089dbb', '3454f112ab267a3b16cccc639eae3a82c4b31928539bb2a2e0ed44df71032dbc', 201, '01a21f2e-769d-76a4-aa39-11f7852a1b2f', 1795819468446720);
INSERT INTO public.idempotency VALUES ('00000000-0000-0000-0000-000000000000', '01a21f2e-76cf-7344-95f4-1d31ff89c928', '33bf07f14d8f9fa28cefd04b6589061414f389a4eab83ae00a1952b277b10122', 201, '01a21f2e-76e3-7168-8f11-0fe19842fff7', 1795819468520783);


--
-- Data for Name: jobs; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.jobs VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', '00000000-0000-0000-0000-000000000000', NULL, NULL, '{}', NULL, NULL, false, '399b53f05096298a3c0247d3125b3993ff6a9b59ce8483b6f4c0c02418e0689a', '{"preset":"preview","iterations":200,"seed":0,"background":"black","model":"tcgs","voxel":"auto","without":[],"lambda":null,"max_bytes":null,"rd_curve":[]}', 'running', 'train', '{"step":160,"total":200,"elapsed_seconds":4.41283022,"eta_seconds":1.07551625525,"steps_per_second":46.46579944540374,"anchors":1310,"gaussians":3745,"loss":0.159925507140783,"psnr":15.527639739898653,"ssim":0.6918123669368916,"bytes":47295}', NULL, NULL, 0, 0, 0, NULL, 1, 1, 3, 0, 0, 149, 0, 'worker-6356-01a21f2e634e7211a82a4c71dfbf5fde', 1795819533507183, NULL, 1795819469504258, 5, 7, 1795819468446720, 1795819468473360, NULL);
INSERT INTO public.jobs VALUES ('01a21f2e-76e3-7168-8f11-0fe19842fff7', '00000000-0000-0000-0000-000000000000', NULL, NULL, '{}', NULL, NULL, false, '399b53f05096298a3c0247d3125b3993ff6a9b59ce8483b6f4c0c02418e0689a', '{"preset":"preview","iterations":20,"seed":0,"background":"black","model":"tcgs","voxel":"auto","without":[],"lambda":null,"max_bytes":null,"rd_curve":[]}', 'queued', 'queued', '{"step":0,"total":0,"elapsed_seconds":0.0,"eta_seconds":null,"steps_per_second":null,"anchors":0,"gaussians":0,"loss":null,"psnr":null,"ssim":null,"bytes":null}', NULL, NULL, 0, 0, 0, NULL, 0, 0, 3, 0, 0, 0, 0, NULL, NULL, NULL, NULL, 1, 1, 1795819468520783, NULL, NULL);
INSERT INTO public.jobs VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', '00000000-0000-0000-0000-000000000000', NULL, NULL, '{}', NULL, NULL, false, '399b53f05096298a3c0247d3125b3993ff6a9b59ce8483b6f4c0c02418e0689a', '{"preset":"preview","iterations":20,"seed":0,"background":"black","model":"tcgs","voxel":"auto","without":[],"lambda":null,"max_bytes":null,"rd_curve":[]}', 'succeeded', 'done', '{"step":20,"total":20,"elapsed_seconds":4.722279278,"eta_seconds":null,"steps_per_second":8.73964788816892,"anchors":242,"gaussians":916,"loss":0.2763974209968001,"psnr":13.121062428682313,"ssim":0.37869377533594767,"bytes":8816}', '{"test":{"psnr":13.564698089898037,"ssim":0.4283192128489888,"lpips":null,"lpips_network":null,"views":8,"per_view":[{"name":"images/view_00.png","psnr":12.265309645651257,"ssim":0.37878283360255177,"lpips":null},{"name":"images/view_06.png","psnr":11.138701190314624,"ssim":0.38377615911766966,"lpips":null},{"name":"images/view_12.png","psnr":13.760527376108485,"ssim":0.48962982235163416,"lpips":null},{"name":"images/view_18.png","psnr":13.408182804769027,"ssim":0.463086999705926,"lpips":null},{"name":"images/view_24.png","psnr":11.913111617016058,"ssim":0.37870573929182555,"lpips":null},{"name":"images/view_30.png","psnr":15.434461273759432,"ssim":0.43988449708619726,"lpips":null},{"name":"images/view_36.png","psnr":14.577883889350385,"ssim":0.44288871718594053,"lpips":null},{"name":"images/view_42.png","psnr":16.019406922215026,"ssim":0.44979893445016583,"lpips":null}]},"train":{"psnr":13.623040503896226,"ssim":0.42666909671752346,"lpips":null,"lpips_network":null,"views":16,"per_view":[{"name":"images/view_01.png","psnr":12.740467574424928,"ssim":0.39728005651457443,"lpips":null},{"name":"images/view_03.png","psnr":12.453358142609105,"ssim":0.3718968690587654,"lpips":null},{"name":"images/view_07.png","psnr":10.679800417286906,"ssim":0.3799461896143775,"lpips":null},{"name":"images/view_09.png","psnr":12.574375073056075,"ssim":0.44508417500939096,"lpips":null},{"name":"images/view_13.png","psnr":13.340202835539703,"ssim":0.48446290287149224,"lpips":null},{"name":"images/view_15.png","psnr":12.418992083862646,"ssim":0.43632791733303905,"lpips":null},{"name":"images/view_19.png","psnr":12.81354903008734,"ssim":0.42346459915703544,"lpips":null},{"name":"images/view_21.png","psnr":13.102218263654791,"ssim":0.4058745184047405,"lpips":null},{"name":"images/view_25.png","psnr":11.935838317730237,"ssim":0.3892678897463955,"lpips":null},{"name":"images/view_27.png","psnr":12.313626083963204,"ssim":0.3964992540978392,"lpips":null},{"name":"images/view_31.png","psnr":15.591985090479291,"ssim":0.4518288611941598,"lpips":null},{"name":"images/view_33.png","psnr":14.785754308682522,"ssim":0.43023957105796806,"lpips":null},{"name":"images/view_37.png","psnr":15.100096572225471,"ssim":0.4617943626043102,"lpips":null},{"name":"images/view_39.png","psnr":16.502260151229702,"ssim":0.49525937110067764,"lpips":null},{"name":"images/view_43.png","psnr":15.687025594994836,"ssim":0.4317011619561037,"lpips":null},{"name":"images/view_45.png","psnr":15.929098522512827,"ssim":0.4257778477595044,"lpips":null}]},"bytes":{"total":8315,"positions":384,"networks":3333,"planes":0,"masks":3,"features":669,"scalings":762,"offsets":2407,"container":757},"seconds":{"ingest":0.129711095,"train":1.958167463,"encode":0.398719842,"decode":0.008150794},"steps":20,"steps_per_second":10.213631049388956,"anchors":242,"gaussians":968,"psnr_before_quantisation":13.558690430423871,"decode_sha256":"97170d1795240151431e9aa6cf5d680c5c6eefe3797bf75d94512ad7881db807","adapter":"llvmpipe (LLVM 15.0.6, 256 bits) (llvmpipe Mesa 25.0.7-2~bpo12+1 (LLVM 15.0.6), vulkan)","background":"black","conventions":{"images":"decoded scene as 8-bit RGB, photograph composited on the same background","psnr":"dB, squared error pooled over pixels and the three channels, at most 100","ssim":"11x11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels","lpips":null,"held_out":"the layout''s own test views; without such, every eighth view by name from the first on","means":"over views, of each view''s figure"},"byte_budget":null,"convergence":null,"coding":{"entropy_overhead":1.0159137556927673,"over_floats":null},"stages":{"views":8,"floats":13.558690430423871,"noise":13.560704350356307,"rounded":13.556337478245311,"decoded":13.564698089898037},"rendering":{"views":1,"size":[32,32],"rmse":1.065177171175735e-7,"max":5.19445532254359e-7,"cutoff_rmse":0.0008484190901544858},"rd_curve":[]}', NULL, 0, 0, 0, NULL, 1, 1, 3, 0, 0, 20, 0, NULL, NULL, NULL, 1795819464600904, 8, 9, 1795819463531052, 1795819463562927, 1795819468351758);


--
-- Data for Name: keys; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: project_blobs; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.project_blobs VALUES ('00000000-0000-0000-0000-000000000000', '5cdb9f96a6c7ed0f51ae380a32fc9dbad12b80209af4a1178434aeae174e7e3e', 1, 'artifact');
INSERT INTO public.project_blobs VALUES ('00000000-0000-0000-0000-000000000000', '2519c7c1690cb177896bc440379f9d60755d43894cd0cd653869c06a7ff36c4f', 1, 'artifact');
INSERT INTO public.project_blobs VALUES ('00000000-0000-0000-0000-000000000000', '94d71b0949a8c6a79d03aa1f6cf0a4e86e62946e8a58548e8f98cb2745f87a7c', 1, 'artifact');
INSERT INTO public.project_blobs VALUES ('00000000-0000-0000-0000-000000000000', '399b53f05096298a3c0247d3125b3993ff6a9b59ce8483b6f4c0c02418e0689a', 3, 'dataset');


--
-- Data for Name: project_totals; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.project_totals VALUES ('00000000-0000-0000-0000-000000000000', 1, 1, 1, 0, 0, 170694, 77279, 0, 0, 4788831, 2);


--
-- Data for Name: projects; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.projects VALUES ('00000000-0000-0000-0000-000000000000', 'default', NULL, NULL, NULL, NULL, 1, 0);


--
-- Data for Name: publications; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: scenes; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: series; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.series VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 0, 1, 0, 0.129714091, NULL, NULL, NULL, 0, 0, NULL);
INSERT INTO public.series VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 499, 1, 10, 1.150688733, 0.28234830408667533, 12.9247932272448, 0.3749988873799642, 242, 884, 12611);
INSERT INTO public.series VALUES ('01a21f2e-6362-79b7-815f-ad03e8eb59d5', 999, 1, 20, 2.290945045, 0.2763974209968001, 13.121062428682313, 0.37869377533594767, 242, 916, 8816);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 0, 1, 0, 0.020322958, NULL, NULL, NULL, 0, 0, NULL);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 49, 1, 10, 0.252059695, 0.36148568813999493, 10.40826350331602, 0.32411181926727295, 242, 884, NULL);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 99, 1, 20, 0.380626054, 0.3481131051946432, 10.726655129780605, 0.3363571206728618, 242, 912, NULL);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 149, 1, 30, 0.551171559, 0.33384192205686125, 10.988646372643881, 0.36011291702588405, 488, 1692, NULL);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 199, 1, 40, 0.726445852, 0.3162273292168664, 11.345542942559842, 0.38774073366324113, 488, 1708, NULL);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 249, 1, 50, 0.92129008, 0.30041115371333743, 11.688709836059331, 0.41401055077314386, 1073, 1665, NULL);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 299, 1, 60, 1.183468199, 0.2854486868725714, 12.033947168280136, 0.43899799940625833, 1073, 3133, NULL);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 349, 1, 70, 1.465168685, 0.2697166951008734, 12.384716419501194, 0.46722209256764263, 1073, 3099, 42192);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 399, 1, 80, 1.785694453, 0.25651257056256505, 12.707012957520954, 0.49256019017784214, 1559, 4464, 57897);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 449, 1, 90, 2.081468068, 0.2409927835007815, 13.070869361058897, 0.5242285231701491, 1559, 4342, 57912);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 499, 1, 100, 2.355873784, 0.22850519782640313, 13.416407181209644, 0.5480884184397025, 1559, 4176, 58055);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 549, 1, 110, 2.660344357, 0.21482563245902703, 13.774640436086651, 0.5758431517045783, 1559, 4311, 57827);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 599, 1, 120, 3.027963632, 0.20228831411152307, 14.131471174882968, 0.6011387613082905, 1559, 4176, 58013);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 649, 1, 130, 3.40147245, 0.19108986184112034, 14.474722988987462, 0.626723124186047, 1559, 3870, 55936);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 699, 1, 140, 3.705052703, 0.1795077190371913, 14.833144273657242, 0.651012987136705, 1559, 3856, 54615);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 749, 1, 150, 4.197684934, 0.16898745127795198, 15.19085291738203, 0.6728880258558959, 1310, 3752, 46296);
INSERT INTO public.series VALUES ('01a21f2e-769d-76a4-aa39-11f7852a1b2f', 799, 1, 160, 4.41283022, 0.159925507140783, 15.527639739898653, 0.6918123669368916, 1310, 3745, 47295);


--
-- Data for Name: total_changes; Type: TABLE DATA; Schema: public; Owner: -
--

INSERT INTO public.total_changes VALUES ('blobs', '', 1);
INSERT INTO public.total_changes VALUES ('blob_bytes', '', 170694);
INSERT INTO public.total_changes VALUES ('blobs', '', 1);
INSERT INTO public.total_changes VALUES ('blob_bytes', '', 8315);
INSERT INTO public.total_changes VALUES ('blobs', '', 1);
INSERT INTO public.total_changes VALUES ('blob_bytes', '', 19331);
INSERT INTO public.total_changes VALUES ('blobs', '', 1);
INSERT INTO public.total_changes VALUES ('blob_bytes', '', 49633);


--
-- Data for Name: totals; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: upload_parts; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: uploads; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: viewers; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: webhook_deliveries; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: webhook_endpoints; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Data for Name: write_probe; Type: TABLE DATA; Schema: public; Owner: -
--



--
-- Name: claim_numbers; Type: SEQUENCE SET; Schema: public; Owner: -
--

SELECT pg_catalog.setval('public.claim_numbers', 2, true);


--
-- Name: publications_id_seq; Type: SEQUENCE SET; Schema: public; Owner: -
--

SELECT pg_catalog.setval('public.publications_id_seq', 1, false);


--
-- Name: webhook_deliveries_seq_seq; Type: SEQUENCE SET; Schema: public; Owner: -
--

SELECT pg_catalog.setval('public.webhook_deliveries_seq_seq', 1, false);


--
-- Name: _sqlx_migrations _sqlx_migrations_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public._sqlx_migrations
    ADD CONSTRAINT _sqlx_migrations_pkey PRIMARY KEY (version);


--
-- Name: artifacts artifacts_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.artifacts
    ADD CONSTRAINT artifacts_pkey PRIMARY KEY (job_id, kind, place);


--
-- Name: attempts attempts_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.attempts
    ADD CONSTRAINT attempts_pkey PRIMARY KEY (job_id, number);


--
-- Name: blob_place blob_place_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.blob_place
    ADD CONSTRAINT blob_place_pkey PRIMARY KEY (id);


--
-- Name: blobs blobs_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.blobs
    ADD CONSTRAINT blobs_pkey PRIMARY KEY (digest);


--
-- Name: counters counters_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.counters
    ADD CONSTRAINT counters_pkey PRIMARY KEY (name, label, cause);


--
-- Name: events events_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.events
    ADD CONSTRAINT events_pkey PRIMARY KEY (job_id, seq);


--
-- Name: exports exports_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.exports
    ADD CONSTRAINT exports_pkey PRIMARY KEY (job_id, source, format);


--
-- Name: idempotency idempotency_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.idempotency
    ADD CONSTRAINT idempotency_pkey PRIMARY KEY (project, key);


--
-- Name: jobs jobs_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.jobs
    ADD CONSTRAINT jobs_pkey PRIMARY KEY (id);


--
-- Name: keys keys_hash_key; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.keys
    ADD CONSTRAINT keys_hash_key UNIQUE (hash);


--
-- Name: keys keys_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.keys
    ADD CONSTRAINT keys_pkey PRIMARY KEY (id);


--
-- Name: project_blobs project_blobs_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.project_blobs
    ADD CONSTRAINT project_blobs_pkey PRIMARY KEY (project, digest);


--
-- Name: project_totals project_totals_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.project_totals
    ADD CONSTRAINT project_totals_pkey PRIMARY KEY (project);


--
-- Name: projects projects_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.projects
    ADD CONSTRAINT projects_pkey PRIMARY KEY (id);


--
-- Name: publications publications_digest_key; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.publications
    ADD CONSTRAINT publications_digest_key UNIQUE (digest);


--
-- Name: publications publications_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.publications
    ADD CONSTRAINT publications_pkey PRIMARY KEY (id);


--
-- Name: scenes scenes_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.scenes
    ADD CONSTRAINT scenes_pkey PRIMARY KEY (id);


--
-- Name: series series_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.series
    ADD CONSTRAINT series_pkey PRIMARY KEY (job_id, bucket);


--
-- Name: totals totals_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.totals
    ADD CONSTRAINT totals_pkey PRIMARY KEY (name, label);


--
-- Name: upload_parts upload_parts_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.upload_parts
    ADD CONSTRAINT upload_parts_pkey PRIMARY KEY (upload, start);


--
-- Name: uploads uploads_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.uploads
    ADD CONSTRAINT uploads_pkey PRIMARY KEY (id);


--
-- Name: viewers viewers_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.viewers
    ADD CONSTRAINT viewers_pkey PRIMARY KEY (url);


--
-- Name: webhook_deliveries webhook_deliveries_id_key; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.webhook_deliveries
    ADD CONSTRAINT webhook_deliveries_id_key UNIQUE (id);


--
-- Name: webhook_deliveries webhook_deliveries_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.webhook_deliveries
    ADD CONSTRAINT webhook_deliveries_pkey PRIMARY KEY (seq);


--
-- Name: webhook_endpoints webhook_endpoints_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.webhook_endpoints
    ADD CONSTRAINT webhook_endpoints_pkey PRIMARY KEY (id);


--
-- Name: write_probe write_probe_pkey; Type: CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.write_probe
    ADD CONSTRAINT write_probe_pkey PRIMARY KEY (id);


--
-- Name: artifacts_by_digest; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX artifacts_by_digest ON public.artifacts USING btree (digest);


--
-- Name: exports_by_digest; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX exports_by_digest ON public.exports USING btree (digest);


--
-- Name: exports_by_source; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX exports_by_source ON public.exports USING btree (source);


--
-- Name: idempotency_by_age; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX idempotency_by_age ON public.idempotency USING btree (created_at);


--
-- Name: jobs_active_by_scene; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_active_by_scene ON public.jobs USING btree (scene) WHERE (state = ANY (ARRAY['queued'::text, 'running'::text]));


--
-- Name: jobs_by_age; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_age ON public.jobs USING btree (created_at, id);


--
-- Name: jobs_by_dataset; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_dataset ON public.jobs USING btree (dataset);


--
-- Name: jobs_by_deadline; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_deadline ON public.jobs USING btree (deadline_at) WHERE ((deadline_at IS NOT NULL) AND (state = 'queued'::text));


--
-- Name: jobs_by_lease; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_lease ON public.jobs USING btree (lease_owner) WHERE (state = 'running'::text);


--
-- Name: jobs_by_name; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_name ON public.jobs USING btree (name, created_at, id) WHERE (name IS NOT NULL);


--
-- Name: jobs_by_project; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_project ON public.jobs USING btree (project, created_at, id);


--
-- Name: jobs_by_project_name; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_project_name ON public.jobs USING btree (project, name, created_at, id) WHERE (name IS NOT NULL);


--
-- Name: jobs_by_project_state; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_project_state ON public.jobs USING btree (project, state, created_at, id);


--
-- Name: jobs_by_retry; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_retry ON public.jobs USING btree (retry_of) WHERE (retry_of IS NOT NULL);


--
-- Name: jobs_by_scene; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_by_scene ON public.jobs USING btree (scene, created_at, id) WHERE (scene IS NOT NULL);


--
-- Name: jobs_queued_by_age; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_queued_by_age ON public.jobs USING btree (created_at) WHERE (state = 'queued'::text);


--
-- Name: jobs_running; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_running ON public.jobs USING btree (project) WHERE (state = 'running'::text);


--
-- Name: jobs_to_claim; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX jobs_to_claim ON public.jobs USING btree (project, priority DESC, created_at, id) WHERE (state = 'queued'::text);


--
-- Name: keys_by_project; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX keys_by_project ON public.keys USING btree (project, id);


--
-- Name: project_totals_queued; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX project_totals_queued ON public.project_totals USING btree (project) WHERE (queued_jobs > 0);


--
-- Name: publications_removing; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX publications_removing ON public.publications USING btree (removing_since) WHERE (removing_since IS NOT NULL);


--
-- Name: scenes_by_age; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX scenes_by_age ON public.scenes USING btree (created_at, id);


--
-- Name: scenes_by_dataset; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX scenes_by_dataset ON public.scenes USING btree (dataset);


--
-- Name: scenes_by_project; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX scenes_by_project ON public.scenes USING btree (project, created_at, id);


--
-- Name: scenes_of_a_project; Type: INDEX; Schema: public; Owner: -
--

CREATE UNIQUE INDEX scenes_of_a_project ON public.scenes USING btree (project, dataset);


--
-- Name: uploads_by_project; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX uploads_by_project ON public.uploads USING btree (project);


--
-- Name: uploads_by_scene; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX uploads_by_scene ON public.uploads USING btree (scene) WHERE (scene IS NOT NULL);


--
-- Name: uploads_ended; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX uploads_ended ON public.uploads USING btree (ended_at) WHERE (ended_at IS NOT NULL);


--
-- Name: uploads_open; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX uploads_open ON public.uploads USING btree (expires_at) WHERE (ended_at IS NULL);


--
-- Name: webhook_deliveries_by_age; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX webhook_deliveries_by_age ON public.webhook_deliveries USING btree (created_at) WHERE (state <> 'pending'::text);


--
-- Name: webhook_deliveries_by_endpoint; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX webhook_deliveries_by_endpoint ON public.webhook_deliveries USING btree (endpoint, seq);


--
-- Name: webhook_deliveries_due; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX webhook_deliveries_due ON public.webhook_deliveries USING btree (due_at, seq) WHERE (state = 'pending'::text);


--
-- Name: webhook_deliveries_under_way; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX webhook_deliveries_under_way ON public.webhook_deliveries USING btree (endpoint) WHERE (lease_until IS NOT NULL);


--
-- Name: webhook_endpoints_by_project; Type: INDEX; Schema: public; Owner: -
--

CREATE INDEX webhook_endpoints_by_project ON public.webhook_endpoints USING btree (project);


--
-- Name: artifacts artifacts_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER artifacts_changed AFTER INSERT OR DELETE ON public.artifacts FOR EACH ROW EXECUTE FUNCTION public.files_changed('artifact');


--
-- Name: attempts attempts_added; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER attempts_added AFTER INSERT ON public.attempts FOR EACH ROW EXECUTE FUNCTION public.attempts_added();


--
-- Name: attempts attempts_ended; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER attempts_ended AFTER UPDATE OF outcome ON public.attempts FOR EACH ROW WHEN (((old.outcome IS NULL) AND (new.outcome IS NOT NULL))) EXECUTE FUNCTION public.attempts_ended();


--
-- Name: blobs blobs_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER blobs_changed AFTER INSERT OR DELETE ON public.blobs FOR EACH ROW EXECUTE FUNCTION public.blobs_changed();


--
-- Name: webhook_deliveries deliveries_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER deliveries_changed AFTER INSERT OR DELETE OR UPDATE OF state ON public.webhook_deliveries FOR EACH ROW EXECUTE FUNCTION public.deliveries_changed();


--
-- Name: events events_told; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER events_told AFTER INSERT ON public.events FOR EACH STATEMENT EXECUTE FUNCTION public.tell('tcgs_events');


--
-- Name: exports exports_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER exports_changed AFTER INSERT OR DELETE ON public.exports FOR EACH ROW EXECUTE FUNCTION public.files_changed('export');


--
-- Name: jobs jobs_added; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER jobs_added AFTER INSERT ON public.jobs FOR EACH ROW EXECUTE FUNCTION public.jobs_added();


--
-- Name: jobs jobs_added_told; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER jobs_added_told AFTER INSERT ON public.jobs FOR EACH STATEMENT EXECUTE FUNCTION public.tell('tcgs_queue');


--
-- Name: jobs jobs_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER jobs_changed AFTER UPDATE OF state ON public.jobs FOR EACH ROW WHEN ((old.state <> new.state)) EXECUTE FUNCTION public.jobs_changed();


--
-- Name: jobs jobs_changed_told; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER jobs_changed_told AFTER UPDATE OF state ON public.jobs FOR EACH ROW WHEN (((old.state <> new.state) AND ((new.state = 'queued'::text) OR (old.state = 'running'::text)))) EXECUTE FUNCTION public.tell('tcgs_queue');


--
-- Name: jobs jobs_measured; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER jobs_measured AFTER UPDATE OF metrics ON public.jobs FOR EACH ROW WHEN (((old.metrics IS NULL) AND (new.metrics IS NOT NULL))) EXECUTE FUNCTION public.jobs_measured();


--
-- Name: jobs jobs_removed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER jobs_removed AFTER DELETE ON public.jobs FOR EACH ROW EXECUTE FUNCTION public.jobs_removed();


--
-- Name: jobs jobs_removing; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER jobs_removing BEFORE DELETE ON public.jobs FOR EACH ROW EXECUTE FUNCTION public.jobs_removing();


--
-- Name: project_blobs project_blobs_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER project_blobs_changed AFTER INSERT OR DELETE ON public.project_blobs FOR EACH ROW EXECUTE FUNCTION public.project_blobs_changed();


--
-- Name: projects projects_added; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER projects_added AFTER INSERT ON public.projects FOR EACH ROW EXECUTE FUNCTION public.projects_added();


--
-- Name: scenes scenes_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER scenes_changed AFTER INSERT OR DELETE ON public.scenes FOR EACH ROW EXECUTE FUNCTION public.scenes_changed();


--
-- Name: uploads uploads_changed; Type: TRIGGER; Schema: public; Owner: -
--

CREATE TRIGGER uploads_changed AFTER INSERT OR DELETE OR UPDATE OF ended_at ON public.uploads FOR EACH ROW EXECUTE FUNCTION public.uploads_changed();


--
-- Name: artifacts artifacts_digest_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.artifacts
    ADD CONSTRAINT artifacts_digest_fkey FOREIGN KEY (digest) REFERENCES public.blobs(digest);


--
-- Name: artifacts artifacts_job_id_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.artifacts
    ADD CONSTRAINT artifacts_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id) ON DELETE CASCADE;


--
-- Name: attempts attempts_job_id_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.attempts
    ADD CONSTRAINT attempts_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id) ON DELETE CASCADE;


--
-- Name: events events_job_id_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.events
    ADD CONSTRAINT events_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id) ON DELETE CASCADE;


--
-- Name: exports exports_digest_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.exports
    ADD CONSTRAINT exports_digest_fkey FOREIGN KEY (digest) REFERENCES public.blobs(digest);


--
-- Name: exports exports_job_id_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.exports
    ADD CONSTRAINT exports_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id) ON DELETE CASCADE;


--
-- Name: exports exports_source_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.exports
    ADD CONSTRAINT exports_source_fkey FOREIGN KEY (source) REFERENCES public.blobs(digest);


--
-- Name: jobs jobs_dataset_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.jobs
    ADD CONSTRAINT jobs_dataset_fkey FOREIGN KEY (dataset) REFERENCES public.blobs(digest);


--
-- Name: jobs jobs_owner_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.jobs
    ADD CONSTRAINT jobs_owner_fkey FOREIGN KEY (owner) REFERENCES public.keys(id);


--
-- Name: jobs jobs_project_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.jobs
    ADD CONSTRAINT jobs_project_fkey FOREIGN KEY (project) REFERENCES public.projects(id);


--
-- Name: jobs jobs_retry_of_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.jobs
    ADD CONSTRAINT jobs_retry_of_fkey FOREIGN KEY (retry_of) REFERENCES public.jobs(id) ON DELETE SET NULL;


--
-- Name: jobs jobs_scene_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.jobs
    ADD CONSTRAINT jobs_scene_fkey FOREIGN KEY (scene) REFERENCES public.scenes(id) ON DELETE SET NULL;


--
-- Name: keys keys_project_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.keys
    ADD CONSTRAINT keys_project_fkey FOREIGN KEY (project) REFERENCES public.projects(id);


--
-- Name: project_totals project_totals_project_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.project_totals
    ADD CONSTRAINT project_totals_project_fkey FOREIGN KEY (project) REFERENCES public.projects(id) ON DELETE CASCADE;


--
-- Name: scenes scenes_dataset_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.scenes
    ADD CONSTRAINT scenes_dataset_fkey FOREIGN KEY (dataset) REFERENCES public.blobs(digest);


--
-- Name: scenes scenes_project_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.scenes
    ADD CONSTRAINT scenes_project_fkey FOREIGN KEY (project) REFERENCES public.projects(id);


--
-- Name: series series_job_id_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.series
    ADD CONSTRAINT series_job_id_fkey FOREIGN KEY (job_id) REFERENCES public.jobs(id) ON DELETE CASCADE;


--
-- Name: upload_parts upload_parts_upload_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.upload_parts
    ADD CONSTRAINT upload_parts_upload_fkey FOREIGN KEY (upload) REFERENCES public.uploads(id) ON DELETE CASCADE;


--
-- Name: uploads uploads_project_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.uploads
    ADD CONSTRAINT uploads_project_fkey FOREIGN KEY (project) REFERENCES public.projects(id);


--
-- Name: uploads uploads_scene_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.uploads
    ADD CONSTRAINT uploads_scene_fkey FOREIGN KEY (scene) REFERENCES public.scenes(id) ON DELETE SET NULL;


--
-- Name: webhook_deliveries webhook_deliveries_endpoint_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.webhook_deliveries
    ADD CONSTRAINT webhook_deliveries_endpoint_fkey FOREIGN KEY (endpoint) REFERENCES public.webhook_endpoints(id) ON DELETE CASCADE;


--
-- Name: webhook_endpoints webhook_endpoints_project_fkey; Type: FK CONSTRAINT; Schema: public; Owner: -
--

ALTER TABLE ONLY public.webhook_endpoints
    ADD CONSTRAINT webhook_endpoints_project_fkey FOREIGN KEY (project) REFERENCES public.projects(id);


--
-- PostgreSQL database dump complete
--

\unrestrict 4Qziv2ybIz41Os9kSiqdp3JcM2vYynazj5YdHyB9Q01XgfojPsyLNTePQm7nR9T

