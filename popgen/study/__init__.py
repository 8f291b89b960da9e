"""People play with blinded egos in the browser.

study_definition    the folder of a study; study_folder makes one, study_texts has its words
counterbalance      who plays what
participant_path    the stations of a participant
study_tables        the database; participant_records and game_records read and write it
hosted_game         one game without a clock; game_host runs all of them
study_server        pages, requests, connections; study_messages says what is taken
"""
