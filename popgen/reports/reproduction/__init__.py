"""Tables and figures of the paper, each made from the records of finished runs.

    target_records        what a target is: the runs that it wants, its columns, the paper's figures
    target_registry       all targets by name
    run_lists             which runs each of them wants, by budget
    measure_definitions   what measures mean, and which figures of older records mean something else
    paper_lines           the paper's figures beside ours
    run_tables            a record as rows with intervals over seeds, tables and CSV
    results_page          records as a page

A record is a JSON object of less than 50 KB (`popgen.pipelines.reproduce` writes it):

    format, format_version   "popgen-reproduction", 1
    target, budget           names
    seeds, settings          of all runs; settings that were given on top of the budget's
    episodes                 of every evaluation that was made for the target; a run's own has its own (`episodes` among
                             the figures of scores, curves and first)
    command                  that makes it again
    written                  day
    runs                     one for each run: row, method, environment, seed, command, run (name of its folder),
                             settings_digest (of what decides its figures), commit and changed (null where unknown),
                             versions, machine (null where unknown), taken_over (made before and taken from elsewhere),
                             seconds, definitions (measure -> text of its meaning, see `measure_definitions`; absent in
                             older records), figures (measure -> name -> number or numbers)
    missing                  rows of runs that are not there: row, environment, seed, why
"""
