"""What people look at in a browser: replays, a run's report, a game against a member. Nothing is loaded from elsewhere.

game_recording    episodes of chosen players, state by state
tile_atlas        pictures as tiles, each distinct one once
replay            a recording as JSON, as a page with a slider, as a GIF
page_template     templates and assets as one self-contained page
"""
