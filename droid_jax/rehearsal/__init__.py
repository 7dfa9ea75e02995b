"""Would the search find what is missing, with this scene, this motion and this noise?"""
