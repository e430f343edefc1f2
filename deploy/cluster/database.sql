-- A database for several revisitd, for psql as a superuser:
--
--   psql -h db.example -U postgres -f deploy/cluster/database.sql
--
-- One role makes the tables (revisitd migrate), the other serves. How they log in is up
-- to pg_hba.conf, and to ALTER ROLE ... PASSWORD.
\set ON_ERROR_STOP on
CREATE ROLE revisit_owner LOGIN;
CREATE ROLE revisit LOGIN;
CREATE DATABASE revisit OWNER revisit_owner TEMPLATE template0 ENCODING 'UTF8' LOCALE 'C';
\connect revisit
ALTER DEFAULT PRIVILEGES FOR ROLE revisit_owner
  GRANT SELECT, INSERT, UPDATE, DELETE ON TABLES TO revisit;
ALTER DEFAULT PRIVILEGES FOR ROLE revisit_owner GRANT USAGE ON SEQUENCES TO revisit;
