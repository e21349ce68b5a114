-- The role of servers and workers, which reads and writes the tables of the job database, and changes none of them. To be
-- run once, by the role that runs `cow migrate`, before that or after it:
--
--     COW_SERVING_PASSWORD=... psql --set ON_ERROR_STOP=1 --file docker/postgres/roles.sql postgresql://cow@db/cow
\getenv password COW_SERVING_PASSWORD
CREATE ROLE cow_serving LOGIN PASSWORD :'password';
GRANT USAGE ON SCHEMA public TO cow_serving;
GRANT SELECT, INSERT, UPDATE, DELETE ON ALL TABLES IN SCHEMA public TO cow_serving;
GRANT USAGE ON ALL SEQUENCES IN SCHEMA public TO cow_serving;
-- And on those that a later version adds.
ALTER DEFAULT PRIVILEGES IN SCHEMA public GRANT SELECT, INSERT, UPDATE, DELETE ON TABLES TO cow_serving;
ALTER DEFAULT PRIVILEGES IN SCHEMA public GRANT USAGE ON SEQUENCES TO cow_serving;
