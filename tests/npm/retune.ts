/** Retunes the first loop in a rehearsal, and a model by one rule: what a user writes on the generated types. */
import createClient from "openapi-fetch";
import type { components, paths } from "./loopwright.js";

const [url, key] = process.argv.slice(2);
const client = createClient<paths>({ baseUrl: url!, headers: { Authorization: `Bearer ${key}` } });

async function rehearsed(tag: string, body: components["schemas"]["FastRetune"]): Promise<components["schemas"]["GainsView"]> {
  const started = await client.POST("/loops/{tag}/retune", { params: { path: { tag } }, body });
  if (started.error) throw new Error(started.error.detail);
  for (let job = started.data; ; ) {
    if (job.state !== "queued" && job.state !== "running") {
      if (!job.new_gains) throw new Error(`${job.state}: ${job.detail}`);
      const log = await client.GET("/jobs/{job_id}/log", { params: { path: { job_id: job.id } } });
      if (log.error) throw new Error(log.error.detail);
      const left = log.data.flatMap((each) => (each.kind === "stage_started" ? [each.remaining_plant_time_s] : []));
      const last = log.data.at(-1);
      if (!left.length || last?.kind !== "state" || last.state !== job.state) throw new Error(JSON.stringify(log.data));
      return job.new_gains;
    }
    await new Promise((resolve) => setTimeout(resolve, 50));
    const now = await client.GET("/jobs/{job_id}", { params: { path: { job_id: job.id } } });
    if (now.error) throw new Error(now.error.detail);
    job = now.data;
  }
}

const loops = await client.GET("/loops");
if (loops.error) throw new Error(loops.error.detail);
const gains = await rehearsed(loops.data[0]!.tag, { method: "fast", dry_run: true, Ms: 1.4 });
console.log(loops.data[0]!.tag, gains.Kp, gains.Ti);

const tuned = await client.POST("/tunings", { body: { model: { K: 0.2, T_s: 2.4, L_s: 1.8 }, method: "simc" } });
if (tuned.error) throw new Error(tuned.error.detail);
console.log(tuned.data.methods[0]!.method, tuned.data.methods[0]!.gains!.Kp, tuned.data.methods[0]!.gains!.Ti);
